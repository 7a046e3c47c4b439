"""What a wheel holds is enough: data files, templates, script, console command. `make package` tries it in clean environments besides."""

import os
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from test_store import make

from topograph import store

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's files, made from the sdist as users get it."""
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(words, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    assert wheel.stat().st_size < 3e6
    with zipfile.ZipFile(wheel) as z:
        z.extractall(folder / "site")
    return folder / "site"


def run(unpacked: Path, *words: object) -> str:
    """The command of the unpacked wheel, not of this checkout."""
    code = f"import sys, topograph; assert topograph.__file__.startswith({str(unpacked)!r}); from topograph.cli import main; main(sys.argv[1:])"
    env = {**os.environ, "PYTHONPATH": str(unpacked)}
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], env=env, cwd=unpacked, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_commands_that_need_data_files_run_from_the_wheel(unpacked: Path, tmp_path: Path) -> None:
    store.save(make(12), tmp_path / "m.gpkg")
    assert "front_end: thesis" in run(unpacked, "config", "-c", "thesis", "--bare")
    run(unpacked, "view", tmp_path / "m.gpkg", tmp_path / "m.html")
    assert (tmp_path / "m.html").stat().st_size > 500_000
    run(unpacked, "export", tmp_path / "m.gpkg", tmp_path / "t.csv")
    assert (unpacked / "topograph" / "trunks" / "score.json").exists()
    assert (unpacked / "topograph" / "report" / "templates" / "report.html").exists()
    assert (unpacked / "topograph" / "py.typed").exists()


def test_metadata_name_what_is_needed_and_no_more(unpacked: Path) -> None:
    (info,) = unpacked.glob("*.dist-info")
    metadata = Parser().parsestr((info / "METADATA").read_text())
    needed = [r for r in metadata.get_all("Requires-Dist") if "extra ==" not in r]
    names = {r.split(">")[0].split("<")[0].split(";")[0].strip() for r in needed}
    assert {"gtsam", "numpy", "numba", "rosbags"} <= names
    assert not names & {"open3d", "open3d-cpu", "rerun-sdk", "geopandas", "pytest", "sphinx"}
    assert "topograph = topograph.cli:main" in (info / "entry_points.txt").read_text()
    assert not [p for name in ("tests", "tools", "docs") for p in unpacked.rglob(name)]
