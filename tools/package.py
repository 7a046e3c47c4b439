"""Does what is shipped work elsewhere? Builds sdist and wheel, installs the wheel into clean environments and runs the commands there.

    python tools/package.py [--python python3.11 ...] [--oldest] [--demo]

In each environment: `pip check`, `doctor`, a simulated run mapped, inspected, viewed and exported; with --demo also `topograph demo`. `--oldest`
installs the oldest versions that pyproject.toml allows (by uv). No extras: open3d and the exchange formats must not be needed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent.parent


def run(*words: object, cwd: Path) -> str:
    """A command's output; it must succeed, and nothing of this checkout may help it."""
    env = {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "VIRTUAL_ENV", "NUMBA_CACHE_DIR"}}
    done = subprocess.run([str(w) for w in words], cwd=cwd, env=env, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(str(w) for w in words)}: exit {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def build(out: Path) -> Path:
    """The wheel, made from the sdist, as PyPI's users get it."""
    run(sys.executable, "-m", "build", "--outdir", out, HERE, cwd=out)
    (wheel,) = out.glob("*.whl")
    return wheel


def try_in(python: str, wheel: Path, oldest: bool, demo: bool) -> str:
    """Install the wheel beside nothing else and use it."""
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder)
        run(python, "-m", "venv", room / "venv", cwd=room)
        at = room / "venv" / "bin"
        if oldest:
            run(sys.executable, "-m", "uv", "pip", "install", "-q", "--resolution", "lowest-direct", "--python", at / "python", wheel, cwd=room)  # fmt: skip
        else:
            run(at / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check", wheel, cwd=room)
            run(at / "python", "-m", "pip", "check", cwd=room)
        size = sum(f.stat().st_size for f in (room / "venv").rglob("*") if f.is_file() and not f.is_symlink())
        began = time.perf_counter()
        program = at / "topograph"
        run(program, "doctor", cwd=room)
        run(program, "simulate", "run.bag", "--longest", 12, "-q", cwd=room)
        run(program, "inspect", "run.bag", cwd=room)
        run(program, "map", "run.bag", "-o", "m.gpkg", "-q", cwd=room)
        run(program, "localize", "m.gpkg", "run.bag", "-q", cwd=room)
        run(program, "view", "m.gpkg", "m.html", cwd=room)
        for name in ("trees.geojson", "trees.csv", "trees.kml", "graph.graphml", "path.tum", "c.ply", "map.mcap"):
            run(program, "export", "m.gpkg", name, cwd=room)
        run(at / "python", "-c", "import topograph; print(topograph.load_map('m.gpkg'))", cwd=room)
        if demo:
            run(program, "demo", "demo", cwd=room)
        return f"{size / 1e6:.0f} MB installed, used in {time.perf_counter() - began:.0f} s"


def main() -> None:
    """Build once, try everywhere."""
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("--python", nargs="*", default=["python3.11", "python3.12", "python3.13"])
    a.add_argument("--oldest", action="store_true", help="Also the oldest dependencies, with the first python.")
    a.add_argument("--demo", action="store_true")
    a.add_argument("--keep", type=Path, help="Folder to leave wheel and sdist in.")
    words = a.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wheel = build(Path(folder))
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB", flush=True)
        for python in words.python:
            print(f"{python}: {try_in(python, wheel, False, words.demo)}", flush=True)
        if words.oldest:
            print(f"{words.python[0]}, oldest: {try_in(words.python[0], wheel, True, False)}", flush=True)
        if words.keep:
            words.keep.mkdir(parents=True, exist_ok=True)
            for f in Path(folder).iterdir():
                shutil.copy(f, words.keep)


if __name__ == "__main__":
    main()
