"""A file that appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST = 200
"""Characters of a name that are kept in that of its part: file systems end at 255 bytes."""


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A name to write to (with the same suffix); it becomes `path` when all went well, and is removed when not. What a link points to is
    written, and keeps who may read it.
    """
    path = Path(os.path.realpath(path))
    part = path.with_name(f".{path.stem[:LONGEST]}.{os.getpid()}.part{path.suffix}")
    part.unlink(missing_ok=True)  # of a process of this number that was killed
    try:
        yield part
        if path.exists():
            part.chmod(path.stat().st_mode & 0o777)
        os.replace(part, path)
    except OSError as err:
        raise OSError(err.errno, err.strerror, str(path)) from err
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file so that a reader sees the old one or the new one, never half."""
    with whole(path) as part:
        part.write_text(text)
