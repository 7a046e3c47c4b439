"""A GeoTIFF (an orthophoto, a satellite picture) laid into a map's frame, to be drawn under it."""

from __future__ import annotations

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


def read_underlay(path: Path, datum: Datum, low: Array, high: Array, most: int = 1400) -> Underlay:
    """The part of a georeferenced picture between `low` and `high` (2,), east and north of `datum`, m; the longer side has `most` pixels.
    Any coordinate system and number format that rasterio (GDAL) reads; what the picture does not show is transparent.

    Raises:
        UsageError: rasterio is not installed.
        InputError: not a georeferenced picture, or one of another place.
    """
    try:
        import rasterio
        from rasterio.errors import RasterioError
        from rasterio.warp import transform
    except ImportError as err:
        raise UsageError(f"{path}: pictures are read by rasterio: pip install 'topograph[exchange]'") from err
    step = float(max(high - low)) / most
    east, north = np.arange(low[0], high[0], step) + 0.5 * step, np.arange(high[1], low[1], -step) - 0.5 * step
    grid = np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)
    geodetic = datum.to_geodetic(np.column_stack([grid, np.zeros(len(grid))]))
    try:
        with rasterio.open(path) as picture:
            if picture.crs is None or picture.transform.is_identity:
                raise InputError(f"{path}: is not georeferenced; give a GeoTIFF")
            x, y = transform("EPSG:4326", picture.crs, geodetic[:, 1], geodetic[:, 0])
            back = ~picture.transform
            column, row = (a * np.asarray(x) + b * np.asarray(y) + c for a, b, c in (back[:3], back[3:6]))
            inside = (column >= 0) & (row >= 0) & (column < picture.width) & (row < picture.height)
            if not inside.any():
                raise InputError(f"{path}: shows another place than the map")
            i, j = np.floor(row[inside]).astype(int), np.floor(column[inside]).astype(int)
            window = ((int(i.min()), int(i.max()) + 1), (int(j.min()), int(j.max()) + 1))
            count = min(picture.count, 3)
            bands = picture.read(list(range(1, count + 1)), window=window)
            shown = picture.dataset_mask(window=window)
    except (RasterioError, OSError, ValueError) as err:
        raise InputError(f"{path}: cannot be read as a picture ({err})") from err
    i, j = i - window[0][0], j - window[1][0]
    out = np.zeros((len(grid), 4), np.uint8)
    colours = _bytes(bands[:, i, j]).T
    out[inside, :3] = colours if colours.shape[1] == 3 else colours[:, :1]
    out[inside, 3] = shown[i, j]
    extent = float(low[0]), float(low[0] + step * len(east)), float(high[1] - step * len(north)), float(high[1])
    return Underlay(out.reshape(len(north), len(east), 4), extent)


def _bytes(bands: NDArray[Any]) -> NDArray[np.uint8]:
    """Bands (B, N) as bytes; what is not in bytes is stretched between its 2nd and 98th percentile."""
    if bands.dtype == np.uint8:
        return bands
    values = bands.astype(float)
    low, high = np.nanpercentile(values, [2, 98])
    return np.asarray(np.nan_to_num(np.clip((values - low) / max(high - low, 1e-12), 0, 1)) * 255, np.uint8)
