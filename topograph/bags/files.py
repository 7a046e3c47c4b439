"""Which files a run's name stands for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from topograph.errors import InputError


def refuse_twice(paths: Sequence[Path]) -> None:
    """Raise InputError where one recording is named twice: its messages would count double."""
    inside = [q.resolve() for p in paths for q in ([p] if p.is_file() else recordings_in(p))]
    for p in inside:
        if inside.count(p) > 1:
            raise InputError(f"{p}: is given twice, by itself or with its folder")


def resolve(path: Path) -> list[Path]:
    """The files (or the ROS 2 folder) that a name stands for."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        inside = recordings_in(path)
        if not inside:
            raise InputError(f"{path}: a folder without a recording; give a .bag, a .mcap, a .db3 or a ROS 2 folder")
        if any(".bag" in p.suffixes for p in inside) and len(inside) > 1:
            raise InputError(
                f"{path}: a folder of {len(inside)} bags; name those of one run: {[p.name for p in inside]}"
            )
        return inside
    if not path.is_dir() and (not path.is_file() or not _RECORDING & set(path.suffixes)):
        raise InputError(f"{path}: not a recording; give a .bag, a .mcap, a .db3 or a ROS 2 folder")
    return [path]


_RECORDING = {".bag", ".mcap", ".db3"}
PACKED = {".zstd", ".zst"}
"""Of a file that ROS 2, or somebody by hand, has compressed as a whole."""


def recordings_in(folder: Path) -> list[Path]:
    """The recordings' files in a folder; those of one run are its parts."""
    plain = [p for p in folder.iterdir() if p.is_file() and p.suffix in {*_RECORDING, ".active"}]
    packed = [p for p in folder.iterdir() if p.is_file() and p.suffix in PACKED and Path(p.stem).suffix in _RECORDING]
    return sorted([*plain, *(p for p in packed if p.with_suffix("") not in plain)])  # `ros2 bag play` leaves both


def side_files(path: Path) -> list[Path]:
    """Journals that stand beside an SQLite recording that was not closed."""
    names = (path.with_name(path.name + end) for end in ("-wal", "-journal"))
    return [p for p in names if path.suffix == ".db3" and p.is_file()]
