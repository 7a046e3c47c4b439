"""A GeoTIFF (an orthophoto, a satellite picture) laid into a map's frame, to be drawn under it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.errors import InputError, UsageError
from topograph.geometry import Array, Datum


@dataclass(frozen=True, slots=True)
class Underlay:
    """A picture (H, W, 4) RGBA, north up, whose `extent` is west, east, south, north in the map's frame, m."""

    pixels: NDArray[np.uint8]
    extent: tuple[float, float, float, float]


def check_picture(path: Path) -> None:
    """Raise, as `read_underlay` does, where the file is no georeferenced picture."""
    with _opened(path):
        pass


def read_underlay(path: Path, datum: Datum, low: Array, high: Array, most: int = 1400) -> Underlay:
    """The part of a georeferenced picture between `low` and `high` (2,), east and north of `datum`, m; the longer side has `most` pixels.
    Any coordinate system and number format that rasterio (GDAL) reads; what the picture does not show is transparent.

    Raises:
        UsageError: rasterio is not installed.
        InputError: not a georeferenced picture.
    """
    step = float(max(high - low)) / most
    east, north = np.arange(low[0], high[0], step) + 0.5 * step, np.arange(high[1], low[1], -step) - 0.5 * step
    grid = np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)
    geodetic = datum.to_geodetic(np.column_stack([grid, np.zeros(len(grid))]))
    out = np.zeros((len(grid), 4), np.uint8)
    with _opened(path) as picture:
        from rasterio.warp import transform

        x, y = transform("EPSG:4326", picture.crs, geodetic[:, 1], geodetic[:, 0])
        back = ~picture.transform
        column, row = (a * np.asarray(x) + b * np.asarray(y) + c for a, b, c in (back[:3], back[3:6]))
        inside = (column >= 0) & (row >= 0) & (column < picture.width) & (row < picture.height)
        if inside.any():
            i, j = np.floor(row[inside]).astype(int), np.floor(column[inside]).astype(int)
            window = ((int(i.min()), int(i.max()) + 1), (int(j.min()), int(j.max()) + 1))
            i, j = i - window[0][0], j - window[1][0]
            bands = picture.read(_colours(picture), window=window)[:, i, j]
            shown = (picture.dataset_mask(window=window)[i, j] > 0) & np.isfinite(bands.astype(float)).all(axis=0)
            out[inside, :3] = _rgb(picture, bands, shown)
            out[inside, 3] = np.where(shown, 255, 0)
    extent = float(low[0]), float(low[0] + step * len(east)), float(high[1] - step * len(north)), float(high[1])
    return Underlay(out.reshape(len(north), len(east), 4), extent)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The picture, and whatever GDAL says of it as an error of ours."""
    try:
        import rasterio
        from rasterio._err import CPLE_BaseError
        from rasterio.errors import RasterioError
    except ImportError as err:
        raise UsageError(f"{path}: pictures are read by rasterio: pip install 'topograph[exchange]'") from err
    try:
        with rasterio.open(path) as picture:
            if picture.crs is None or picture.transform.is_identity:
                raise InputError(f"{path}: is not georeferenced; give a GeoTIFF")
            yield picture
    except (RasterioError, CPLE_BaseError, OSError, ValueError) as err:
        raise InputError(f"{path}: cannot be read as a picture ({err})") from err


def _colours(picture: Any) -> list[int]:
    """Bands of red, green, blue, by what the file calls them, or the first three; one band of grey, or of a palette."""
    names = [c.name for c in picture.colorinterp]
    if {"red", "green", "blue"} <= set(names):
        return [names.index(c) + 1 for c in ("red", "green", "blue")]
    plain = [k + 1 for k, c in enumerate(names) if c != "alpha"]
    return plain[:3] if len(plain) >= 3 else plain[:1] or [1]


def _rgb(picture: Any, bands: NDArray[Any], shown: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Colours (N, 3) of values (B, N): by the palette, as they are, or stretched between the 2nd and 98th percentile of what is `shown`."""
    if len(bands) == 1 and picture.colorinterp[0].name == "palette":
        table = np.zeros((int(bands.max(initial=0)) + 1, 4), np.uint8)
        for k, colour in picture.colormap(1).items():
            if k < len(table):
                table[k] = colour
        return table[bands[0].astype(int), :3]
    values = bands
    if bands.dtype != np.uint8:
        known = bands[:, shown].astype(float)
        low, high = np.percentile(known, [2, 98]) if known.size else (0.0, 1.0)
        with np.errstate(invalid="ignore"):
            values = np.nan_to_num(np.clip((bands.astype(float) - low) / max(high - low, 1e-12), 0, 1)) * 255
    return np.asarray(np.broadcast_to(values.T, (bands.shape[1], 3)), np.uint8)
