"""Settings: what none can be is refused by name, what one can be is kept, and every number is held to a range."""

from dataclasses import fields
from typing import Any, get_args, get_type_hints

import pytest

from topograph.config import Config, dump, from_dict, load
from topograph.errors import UsageError


@pytest.mark.parametrize(
    ("room", "key", "value"),
    [
        ("topomap", "edges", "nonsense"),
        ("localize", "risk", 5.0),
        ("localize", "risk", 0.0),
        ("localize", "view", float("nan")),
        ("localize", "scale_prior", [1.0]),
        ("trees", "gate", -1.0),
        ("motion", "along", float("nan")),
        ("motion", "tilt_time_s", float("inf")),
        ("estimate", "iterations", 0),
        ("estimate", "fix_floor", [0.01, -0.02]),
        ("estimate", "huber", "much"),
        ("trunks", "high", 0.1),
        ("trunks", "front_end", "mine"),
    ],
)
def test_nonsense_is_refused_by_name(room: str, key: str, value: Any) -> None:
    with pytest.raises(UsageError, match=f"{room}.{key}"):
        from_dict({room: {key: value}})


def test_every_number_has_a_range() -> None:
    """A bare float takes NaN, and a bare int takes less than nothing; only bounds that may be infinite are bare."""
    bare = []
    for room in fields(Config):
        block = type(getattr(Config(), room.name))
        for name, hint in get_type_hints(block, include_extras=True).items():
            kinds = {hint, *get_args(hint)} if not hasattr(hint, "__metadata__") else set()
            if kinds & {float, int}:
                bare.append(f"{room.name}.{name}")
    assert bare == ["thesis_trunks.intensity_min", "thesis_trunks.intensity_max"]


def test_what_is_printed_can_be_read(tmp_path: Any) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(dump(Config()))
    assert load(path) == Config()
