"""What really was there: trees and path, read from the folder beside a simulated bag."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.errors import InputError
from topograph.exchange.tum import read_tum, write_tum
from topograph.geometry import Array, Datum, Stamps

_COLUMNS = ("id", "lat", "lon", "h", "x", "y", "z", "axis_x", "axis_y", "axis_z", "diameter", "stems")


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Trees and path in the ENU frame of `datum` ("world"), or in a local frame. Either may be missing.

    Attributes:
        datum: of the frame; None where it is local.
        trees: (N, 3) where each trunk's axis meets the ground, m.
        axes: (N, 3) unit vectors, up.
        diameters: (N,) at 0.8 m above ground, m.
        stems: (N,) stems that the tree divides into near the ground.
        stamps_ns: (M,) of the path.
        world_T_robot: (M, 4, 4).
        scan_stamps_ns: (S,) of the scans, or empty.
        returns: (S, N) LiDAR returns from each trunk below 1.6 m in each scan, or empty.
        sigma: the truth's own standard deviation, m; NaN where nobody states it.
    """

    datum: Datum | None
    trees: Array
    axes: Array
    diameters: Array
    stems: NDArray[np.int64]
    stamps_ns: Stamps
    world_T_robot: Array
    scan_stamps_ns: Stamps
    returns: NDArray[np.int32]
    sigma: float = 0.0

    @staticmethod
    def of_path(
        stamps_ns: Stamps, world_T_robot: Array, datum: Datum | None = None, sigma: float = float("nan")
    ) -> Truth:
        """A path (M,), (M, 4, 4) alone."""
        n = np.zeros((0, 3))
        scans_ns, returns = _no_returns(0)
        return Truth(
            datum=datum, trees=n, axes=n, diameters=np.zeros(0), stems=np.zeros(0, np.int64), stamps_ns=stamps_ns, world_T_robot=world_T_robot,
            scan_stamps_ns=scans_ns, returns=returns, sigma=sigma,
        )  # fmt: skip

    @staticmethod
    def of_trees(
        datum: Datum | None, trees: Array, *, axes: Array, diameters: Array, stems: NDArray[np.int64], sigma: float
    ) -> Truth:
        """Trees (N, 3) alone."""
        scans_ns, returns = _no_returns(len(trees))
        return Truth(
            datum=datum, trees=trees, axes=axes, diameters=diameters, stems=stems, stamps_ns=np.zeros(0, np.int64),
            world_T_robot=np.zeros((0, 4, 4)), scan_stamps_ns=scans_ns, returns=returns, sigma=sigma,
        )  # fmt: skip

    def save(self, folder: Path) -> None:
        """Write `trees.csv`, `path.tum`, `datum.json`, `returns.npz` into `folder`; the frame must be georeferenced."""
        assert self.datum is not None
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "datum.json").write_text(
            json.dumps({"lat": self.datum.lat, "lon": self.datum.lon, "h": self.datum.h}) + "\n"
        )
        geodetic = self.datum.to_geodetic(self.trees)
        with (folder / "trees.csv").open("w", newline="") as f:
            writer = csv.writer(f)
            writer.writerow(_COLUMNS)
            for i in range(len(self.trees)):
                row = [*geodetic[i], *self.trees[i], *self.axes[i], self.diameters[i]]
                writer.writerow([i, *(repr(float(v)) for v in row), int(self.stems[i])])
        write_tum(folder / "path.tum", self.stamps_ns, self.world_T_robot)
        np.savez_compressed(folder / "returns.npz", stamps_ns=self.scan_stamps_ns, returns=self.returns)

    @staticmethod
    def load(folder: Path) -> Truth:
        """Read what `save` wrote.

        Raises:
            InputError: a file is missing or not of this layout.
        """
        try:
            d = json.loads((folder / "datum.json").read_text())
            with (folder / "trees.csv").open(newline="") as f:
                rows = list(csv.DictReader(f))
            stamps, poses = read_tum(folder / "path.tum")
            scans, returns = np.zeros(0, np.int64), np.zeros((0, len(rows)), np.int32)
            if (folder / "returns.npz").exists():
                with np.load(folder / "returns.npz", allow_pickle=False) as z:
                    scans, returns = z["stamps_ns"], z["returns"]
        except (OSError, ValueError, KeyError) as err:
            raise InputError(
                f"{folder}: not a truth folder ({err}); give the <name>.truth folder beside the bag"
            ) from err

        def column(*names: str) -> Array:
            return np.array([[float(r[n]) for n in names] for r in rows]).reshape(len(rows), len(names))

        return Truth(
            datum=Datum(d["lat"], d["lon"], d["h"]),
            trees=column("x", "y", "z"),
            axes=column("axis_x", "axis_y", "axis_z"),
            diameters=column("diameter")[:, 0],
            stems=column("stems")[:, 0].astype(np.int64),
            stamps_ns=stamps,
            world_T_robot=poses,
            scan_stamps_ns=scans,
            returns=returns,
        )


def _no_returns(n: int) -> tuple[Stamps, NDArray[np.int32]]:
    return np.zeros(0, np.int64), np.zeros((0, n), np.int32)
