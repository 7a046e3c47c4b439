"""Trajectories as TUM: stamp in seconds with 9 decimals, x y z, quaternion x y z w."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from topograph.errors import InputError
from topograph.geometry import Array, Stamps, from_quaternion, to_quaternion


def write_tum(path: Path, stamps_ns: Stamps, poses: Array) -> None:
    """Poses (N, 4, 4) as TUM: stamp in seconds with 9 decimals, x y z, quaternion x y z w."""
    with path.open("w") as f:
        f.writelines(f"{line}\n" for line in _lines(stamps_ns, poses))


def write_wide_tum(path: Path, stamps_ns: Stamps, poses: Array, cov: Array) -> None:
    """TUM with 21 more columns: the lower triangle, row by row, of each pose's covariance (N, 6, 6) as `geometry.tangent_cov` gives it
    ("wide TUM", as smfeval reads it).
    """
    i, j = np.tril_indices(6)
    with path.open("w") as f:
        for line, c in zip(_lines(stamps_ns, poses), cov, strict=True):
            f.write(f"{line} {' '.join(f'{v:.6e}' for v in c[i, j])}\n")


def _lines(stamps_ns: Stamps, poses: Array) -> Iterator[str]:
    q = to_quaternion(poses) if len(poses) else np.zeros((0, 4))
    for s, T, r in zip(stamps_ns.tolist(), poses, q, strict=True):
        values = " ".join(f"{v:.9f}" for v in (*T[:3, 3], *r))
        yield f"{s // 1_000_000_000}.{s % 1_000_000_000:09d} {values}"


def read_tum(path: Path) -> tuple[Stamps, Array]:
    """Stamps (N,) in ns and poses (N, 4, 4) of a TUM file; stamps are read without rounding through floats.

    Raises:
        InputError: a line has not eight numbers.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for n, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        if len(words) != 8:
            raise InputError(f"{path}:{n}: {len(words)} columns, TUM has 8 (stamp x y z qx qy qz qw)")
        whole, _, fraction = words[0].partition(".")
        stamps.append(int(whole) * 1_000_000_000 + int((fraction + "000000000")[:9]))
        rows.append([float(w) for w in words[1:]])
    values = np.array(rows).reshape(-1, 7)
    return np.array(stamps, np.int64), from_quaternion(values[:, :3], values[:, 3:]).reshape(-1, 4, 4)
