"""One LiDAR sweep, decoded from `sensor_msgs/PointCloud2` of any field layout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.errors import InputError

_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_RING_NAMES = ("ring", "channel", "laser_id", "line", "laser_number")
_TIME_NAMES = ("time", "t", "timestamp", "time_offset", "offset_time", "timeoffset", "time_stamp", "rel_time")


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Points of one sweep in the sensor's frame, order kept as recorded (unreturned points are NaN or dropped).

    Attributes:
        stamp_ns: header stamp.
        frame: sensor frame.
        xyz: (N, 3) float32, m.
        ring: (N,) int32 laser index from the field, or None.
        offset: (N,) float32 seconds after `stamp_ns` (may be negative), or None.
        intensity: (N,) float32, or None.
    """

    stamp_ns: int
    frame: str
    xyz: NDArray[np.float32]
    ring: NDArray[np.int32] | None
    offset: NDArray[np.float32] | None
    intensity: NDArray[np.float32] | None


def decode(message: Any, stamp_ns: int) -> Scan:
    """Scan of a deserialised PointCloud2.

    Raises:
        InputError: no x, y, z fields, a field outside the point, or less data than announced.
    """
    view = _view(message)
    names = {n.lower(): n for n in view.dtype.names or ()}
    if not all(a in names for a in "xyz"):
        raise InputError(f"PointCloud2 has fields {sorted(names)}, not x, y and z: choose another --topic-points")
    xyz = np.empty((len(view), 3), np.float32)
    for k, a in enumerate("xyz"):
        xyz[:, k] = view[names[a]]
    ring_name = next((names[n] for n in _RING_NAMES if n in names), None)
    if ring_name is not None and ring_name.lower() == "line" and "tag" in names:
        ring_name = None  # a Livox driver's: its lines wander over the whole view
    ring = None if ring_name is None else view[ring_name].astype(np.int32)
    intensity_name = next((names[n] for n in ("intensity", "i", "reflectivity") if n in names), None)
    intensity = None if intensity_name is None else np.asarray(view[intensity_name], np.float32)  # no copy: seldom used
    return Scan(
        stamp_ns=stamp_ns,
        frame=message.header.frame_id.lstrip("/"),
        xyz=xyz,
        ring=ring,
        offset=_offsets(view, names, stamp_ns),
        intensity=intensity,
    )


def _view(message: Any) -> NDArray[Any]:
    """One-dimensional structured view of the points, no copy unless rows are padded."""
    order = ">" if message.is_bigendian else "<"
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    names, formats, offsets = [], [], []
    for f in message.fields:
        if f.datatype not in _DTYPES or not f.name or f.name in names:
            continue
        base = order + _DTYPES[f.datatype]
        if f.offset + np.dtype(base).itemsize * max(f.count, 1) > step:
            raise InputError(f"PointCloud2 field {f.name!r} lies outside its {step}-byte point: the message is damaged")
        names.append(f.name)
        formats.append(base if f.count <= 1 else f"({f.count},){base}")
        offsets.append(f.offset)
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    data = np.ascontiguousarray(message.data).view(np.uint8)
    row = int(message.row_step) if height > 1 and message.row_step else width * step
    if width * height == 0:
        return np.zeros(0, dtype)
    if len(data) < row * (height - 1) + width * step:
        raise InputError(f"PointCloud2 announces {width}x{height} points and holds {len(data)} bytes: it is truncated")
    if row == width * step:
        return data[: width * height * step].view(dtype)
    rows = [data[r * row : r * row + width * step].view(dtype) for r in range(height)]
    return np.concatenate(rows)


def _offsets(view: NDArray[Any], names: dict[str, str], stamp_ns: int) -> NDArray[np.float32] | None:
    """Seconds of each point after the header stamp; the unit is the one that makes a sweep last a sweep's time."""
    if len(view) < 2:
        return None
    if "time_sec" in names and "time_nsec" in names:
        ns = view[names["time_sec"]].astype(np.int64) * 1_000_000_000 + view[names["time_nsec"]].astype(np.int64)
        t: NDArray[Any] = (ns - (stamp_ns if ns.max() > 10**15 else 0)) * 1e-9
    else:
        name = next((names[n] for n in _TIME_NAMES if n in names), None)
        if name is None or view[name].ndim > 1:
            return None
        raw = view[name]
        low, high = np.fmin.reduce(raw), np.fmax.reduce(raw)  # NaN is passed over
        if not (np.isfinite(low) and np.isfinite(high)):
            return None
        span = float(high) - float(low)
        unit = next((u for u in (1.0, 1e-3, 1e-6, 1e-9) if 2e-3 <= span * u <= 2.0), None)
        if unit is None:
            return None
        base = 0.0
        if max(abs(float(high)), abs(float(low))) * unit > 1e6:  # absolute: seconds since 1970
            whole = np.round(float(low) * unit)
            base = whole / unit
            shift = whole - stamp_ns * 1e-9
        else:
            shift = 0.0
        if raw.dtype == np.float32 and unit == 1.0 and shift == 0.0:
            return np.ascontiguousarray(raw) if max(abs(float(low)), abs(float(high))) <= 2.0 else None
        if raw.dtype.kind == "f":
            t = (raw.astype(float) - base) * unit + shift
        else:
            t = (raw.astype(np.int64) - int(base)) * unit + shift
    if not np.isfinite(t).any() or np.nanmax(t) - np.nanmin(t) < 2e-3 or np.nanmax(np.abs(t)) > 2.0:
        return None
    return t.astype(np.float32)
