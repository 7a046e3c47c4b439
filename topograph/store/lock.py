"""One writer at a time, and what killed ones left behind."""

from __future__ import annotations

import fcntl
import glob
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from topograph.errors import MapError
from topograph.whole import LONGEST


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """The one writer of a map, from loading it to saving it. The lock dies with its process; who holds it stands in the lock file.

    Raises:
        MapError: somebody else writes it.
    """
    path = path.resolve()
    lock = path.with_name(f".{path.name}.lock")
    if not path.parent.is_dir():
        raise MapError(f"{path}: there is no folder {path.parent}")
    while True:
        try:
            handle = lock.open("a+")
        except OSError as err:
            raise MapError(f"{path}: cannot be written ({err.strerror})") from err
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.seek(0)
            who = handle.read(200).strip() or "another process"
            handle.close()
            raise MapError(f"{path}: {who} is writing it; wait until it is done") from None
        if lock.exists() and os.fstat(handle.fileno()).st_ino == lock.stat().st_ino:
            break
        handle.close()  # its holder has just finished, and removed it
    try:
        handle.truncate(0)
        handle.write(f"process {os.getpid()} on {socket.gethostname()}")
        handle.flush()
        yield
    finally:
        lock.unlink(missing_ok=True)
        handle.close()


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def sweep(path: Path) -> None:
    """Remove what killed writers of this map left behind."""
    for part in path.parent.glob(f".{glob.escape(path.stem[:LONGEST])}.*.part{glob.escape(path.suffix)}*"):
        pid = part.name.removeprefix(f".{path.stem[:LONGEST]}.").split(".")[0]
        if pid.isdigit() and int(pid) != os.getpid() and not alive(int(pid)):
            part.unlink(missing_ok=True)
