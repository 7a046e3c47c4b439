"""Why a bag does not open, and what to do about it."""

from __future__ import annotations

from pathlib import Path


def why_unreadable(path: Path, err: BaseException) -> str:
    """One line for a bag that cannot be opened: the reason, and the command that mends it."""
    size = path.stat().st_size if path.is_file() else 0
    if path.is_file() and size == 0:
        return "the file is empty"
    if path.suffix == ".bag":
        with path.open("rb") as f:
            magic = f.read(13)
        if not magic.startswith(b"#ROSBAG V2.0"):
            return "not a ROS 1 bag (version 2.0)"
        return f"truncated or never closed ({err}); make it whole with `rosbag reindex {path.name}`"
    if path.suffix == ".mcap":
        return f"truncated or damaged ({err}); make it whole with `mcap recover {path.name} -o recovered.mcap`"
    if path.suffix == ".db3":
        return f"damaged ({err}); try `sqlite3 {path.name} .recover`"
    return f"cannot be opened ({err}); check metadata.yaml, or name the .mcap or .db3 inside"
