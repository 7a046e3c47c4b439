"""What `localize` left of a run, read back: for the page that replays it, and for ROS."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.errors import InputError
from topograph.geometry import Array, Stamps, from_quaternion


@dataclass(frozen=True, slots=True, kw_only=True)
class Localized:
    """Of S scans.

    Attributes:
        stamps_ns, state: (S,), and a word each.
        map_T_robot: (S, 4, 4) committed poses, NaN where there is none.
        along, across: (S,) deviations along and across the rows, m, NaN without a pose.
        count: (S,) places that were left.
        trees: (S,) ids of the trees that were seen, an array each.
        places: (S,) of each scan without a pose: x, y (m), yaw (rad) and weight (H, 4) of the most probable places.
    """

    stamps_ns: Stamps
    state: list[str]
    map_T_robot: Array
    along: Array
    across: Array
    count: NDArray[np.int64]
    trees: list[NDArray[np.int64]]
    places: list[Array]

    @property
    def placed(self) -> NDArray[np.bool_]:
        """(S,) there is a pose."""
        return np.asarray(np.isfinite(self.map_T_robot[:, 0, 3]))


def read_localization(folder: Path) -> Localized:
    """`localization.csv` and `hypotheses.csv` of a results folder.

    Raises:
        InputError: the folder holds none.
    """
    try:
        rows = _rows(folder / "localization.csv")
        places: dict[int, list[list[float]]] = {}
        if (folder / "hypotheses.csv").exists():
            for r in _rows(folder / "hypotheses.csv"):
                places.setdefault(_ns(r["stamp"]), []).append([float(r[k]) for k in ("x", "y", "yaw", "weight")])

        def column(name: str) -> Array:
            return np.array([float(r[name]) if r[name] else np.nan for r in rows])

        stamps = np.array([_ns(r["stamp"]) for r in rows], np.int64)
        poses = np.full((len(rows), 4, 4), np.nan)
        known = np.isfinite(column("x"))
        at, turn = (
            np.stack([column(k) for k in names], axis=1)[known] for names in (("x", "y", "z"), ("qx", "qy", "qz", "qw"))
        )
        if known.any():
            poses[known] = from_quaternion(at, turn)
        out = Localized(
            stamps_ns=stamps, state=[r["state"] for r in rows], map_T_robot=poses, along=column("sigma_along"), across=column("sigma_across"),
            count=np.array([int(r["hypotheses"]) for r in rows], np.int64),
            trees=[np.array(r["tree_ids"].split(), np.int64) for r in rows],
            places=[np.array(places.get(s, [])).reshape(-1, 4) for s in stamps.tolist()],
        )  # fmt: skip
    except (OSError, KeyError, ValueError) as err:
        raise InputError(
            f"{folder}: no localization in it ({err}); give the results folder of `topograph localize`"
        ) from err
    if not len(out.stamps_ns):
        raise InputError(f"{folder}: the localization has no scans")
    return out


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as f:
        return list(csv.DictReader(f))


def _ns(stamp: str) -> int:
    """Seconds with nine decimals, as they were written: a float would lose the last hundred nanoseconds."""
    whole, _, fraction = stamp.partition(".")
    return int(whole) * 10**9 + int(fraction.ljust(9, "0")[:9] or 0)
