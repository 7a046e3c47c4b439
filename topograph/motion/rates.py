"""Do gyro and wheels tell of the same turns? Lag, scale and sign, by correlation of yaw rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from topograph.geometry import Array, Datum, Stamps, wrap, yaw_of
from topograph.motion.streams import Streams
from topograph.motion.wheels import GOOD_FIX

STEP_S = 0.05
SMOOTH = 9
"""Steps over which rates are averaged before they are compared."""
LEAST = 0.03
"""Standard deviation of the wheels' yaw rate below which there is nothing to compare, rad/s."""
LONGEST_S = 8.0
"""Lag that is looked for."""
ALIKE = 0.8
"""Correlation from which two rates are of one motion."""
TURNED_ROUND = -0.6
SCALE = (0.7, 1.4)
"""Slope of gyro on wheels: wheels slip in turns, and their base is not known better."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Of rate a on rate b: `correlation` and `slope` with a's clock moved by `lag` s; what they are as stamped, `as_stamped`."""

    correlation: float
    slope: float
    lag: float
    as_stamped: float

    @property
    def right(self) -> bool:
        """Both tell of the same turns, once a's clock is set right.

        What runs against the other as stamped is turned round, and not late by half a period of a robot that goes to and fro.
        """
        alike = self.correlation > ALIKE and SCALE[0] < self.slope < SCALE[1]
        return alike and abs(self.lag) < LONGEST_S - 2 * STEP_S and self.as_stamped > TURNED_ROUND


def compare(a_ns: Stamps, a: Array, b_ns: Stamps, b: Array) -> Agreement | None:
    """Yaw rates a (N,) and b (M,) at their stamps; None where b hardly turns, or they do not overlap."""
    margin = int(LONGEST_S * 1e9)
    start, stop = max(a_ns[0], b_ns[0]), min(a_ns[-1], b_ns[-1])
    if stop - start < 10_000_000_000:
        return None
    t = np.arange(start, stop, int(STEP_S * 1e9))
    y = np.asarray(uniform_filter1d(np.interp(t, b_ns, b), SMOOTH), float)
    if float(y.std()) < LEAST:
        return None
    wide = np.arange(start - margin, stop + margin, int(STEP_S * 1e9))
    x = np.asarray(uniform_filter1d(np.interp(wide, a_ns, a), SMOOTH), float)
    k = int(LONGEST_S / STEP_S)
    lags = np.arange(-k, k + 1)
    n = len(t)
    r = np.array([_correlation(x[k + s : k + s + n], y) for s in lags])
    best = int(np.argmax(r))
    at = best + _vertex(r, best)
    lag = (np.interp(at, np.arange(len(lags)), lags)) * STEP_S
    moved = x[k + lags[best] : k + lags[best] + n]
    slope = float(np.sum((moved - moved.mean()) * (y - y.mean())) / np.sum((y - y.mean()) ** 2))
    return Agreement(float(r[best]), slope, float(lag), float(r[k]))


def _correlation(x: Array, y: Array) -> float:
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / np.sqrt(max(float(x @ x), 1e-12) * max(float(y @ y), 1e-12)))


def _vertex(r: Array, i: int) -> float:
    if not 0 < i < len(r) - 1:
        return 0.0
    bend = r[i - 1] - 2 * r[i] + r[i + 1]
    return float(np.clip(0.5 * (r[i - 1] - r[i + 1]) / bend, -0.5, 0.5)) if bend < -1e-12 else 0.0


def wheel_rate(streams: Streams) -> tuple[Stamps, Array]:
    """Stamps (O-1,) and yaw rates (O-1,) between odometry's poses."""
    ns = streams.odometry_ns
    dt = np.maximum(np.diff(ns) * 1e-9, 1e-3)
    rate = wrap(np.diff(yaw_of(streams.odom_T_child))) / dt
    middle = ns[:-1] + np.diff(ns) // 2
    sane = np.abs(rate) < 10.0
    return middle[sane], rate[sane]


def outside_rate(streams: Streams) -> tuple[Stamps, Array] | None:
    """Yaw rates that neither gyro nor wheels had a part in: of the heading receiver, else of the fixes' course; None without."""
    ns, yaw = streams.heading_ns, streams.heading
    if len(ns) < 20:
        ns, yaw = _course(streams)
    if len(ns) < 20:
        return None
    dt = np.diff(ns) * 1e-9
    near = np.asarray((dt > 1e-3) & (dt < 2.0))
    rate = wrap(np.diff(yaw)) / np.maximum(dt, 1e-3)
    near &= np.abs(rate) < 3.0
    middle = ns[:-1] + np.diff(ns) // 2
    return (middle[near], rate[near]) if near.sum() >= 20 else None


def _course(streams: Streams) -> tuple[Stamps, Array]:
    """Direction of travel between good fixes half a metre apart, at their middle."""
    good = (
        np.sqrt(streams.fix_cov[:, [0, 1], [0, 1]].max(axis=1)) < GOOD_FIX if len(streams.fix_ns) else np.zeros(0, bool)
    )
    if good.sum() < 20:
        return np.zeros(0, np.int64), np.zeros(0)
    g, ns = streams.lat_lon_h[good], streams.fix_ns[good]
    enu = Datum(*(float(v) for v in np.median(g, axis=0))).to_enu(g)[:, :2]
    stamps, course = [], []
    a = 0
    for b in range(1, len(enu)):
        move = enu[b] - enu[a]
        if np.hypot(*move) > 0.5:
            if ns[b] - ns[a] < 3_000_000_000:
                stamps.append((ns[a] + ns[b]) // 2)
                course.append(np.arctan2(move[1], move[0]))
            a = b
    return np.array(stamps, np.int64), np.array(course)
