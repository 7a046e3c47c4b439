"""The walls: what may be imported where is derived from the layers, so that a new room is covered by itself."""

import tomllib
from pathlib import Path

import mutate
import pytest

PROJECT = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())
CONTRACTS = PROJECT["tool"]["importlinter"]["contracts"]
ROOMS = {r.strip() for layer in CONTRACTS[0]["layers"] for r in layer.split("|")}
ONLY_IN = {
    "rosbags": {"bags"},
    "gtsam": {"estimate", "localize"},
    "matplotlib": {"report"},
    "small_gicp": {"topomap"},
    "open3d": {"trunks", "localize"},
    "click": {"cli"},
    "pydantic": {"config"},
}
"""Rooms that a library is for; every other is forbidden to import it."""


def test_every_room_has_its_layer() -> None:
    top = Path(__file__).parent.parent / "topograph"
    there = {p.stem for p in top.iterdir() if (p.is_dir() and (p / "__init__.py").exists()) or p.suffix == ".py"}
    assert there - {"__init__"} == ROOMS


@pytest.mark.parametrize("library", ONLY_IN)
def test_libraries_stay_in_their_rooms(library: str) -> None:
    """The contract that `make check` runs names every room but those."""
    mine = [c for c in CONTRACTS if library in c.get("forbidden_modules", [])]
    assert len(mine) == 1
    assert set(mine[0]["source_modules"]) == {f"topograph.{r}" for r in ROOMS - ONLY_IN[library]}


@pytest.mark.parametrize("each", mutate.BREAKS, ids=lambda b: b.name)
def test_the_deliberate_breaks_still_break_something(each: mutate.Break) -> None:
    """A break whose text has moved is no break, and would count as caught by nobody."""
    assert (mutate.ROOT / each.file).read_text().count(each.old) >= 1
