"""Do gyro and wheels tell of the same turns? Lag, scale and sign, by correlation of yaw rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, Stamps, wrap, yaw_of
from topograph.motion.wheels import GOOD_FIX
from topograph.session import Streams

STEP_S = 0.1
"""Between the moments that are compared."""
HALF_S = 0.2
"""A rate is the turn from so long before to so long after a moment: samples are averaged, not picked."""
GAP_S = 0.25
"""Where a stream has no sample for longer, it says nothing."""
LEAST = 0.03
"""Standard deviation of the wheels' yaw rate below which there is nothing to compare, rad/s; and of the gyro's, where the wheels'
is no more than three times that: they may only shake."""
LONGEST_S = 8.0
"""Lag that is looked for."""
LEAST_MOMENTS = 60
ALIKE = 0.85
"""Correlation from which two rates are of one motion."""
TURNED_ROUND = -0.6
SCALE = (0.2, 3.2)
"""Slope of gyro on wheels that is one of scale alone: a skid-steered robot turns by half of what its wheels say."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Of rate a on rate b: `correlation` and `slope` with a's clock moved by `lag` s; what they are as stamped, `as_stamped`."""

    correlation: float
    slope: float
    lag: float
    as_stamped: float

    @property
    def right(self) -> bool:
        """Both tell of the same turns, once a's clock is set right; their scale may differ.

        What runs against the other as stamped is turned round, and not late by half a period of a robot that goes to and fro.
        """
        alike = self.correlation > ALIKE and SCALE[0] < self.slope < SCALE[1]
        return alike and abs(self.lag) < LONGEST_S - 2 * STEP_S and self.as_stamped > TURNED_ROUND


def compare(a_ns: Stamps, a: Array, b_ns: Stamps, b: Array) -> Agreement | None:
    """Yaw rates a (N,) and b (M,) at their stamps; None where b hardly turns, or they do not overlap for long enough.

    Only moments at which both have samples count; what lies between recordings costs nothing.
    """
    if len(a_ns) < 10 or len(b_ns) < 10:
        return None
    zero = min(int(a_ns[0]), int(b_ns[0]))
    x, y = (_Turned(np.asarray((ns - zero) * 1e-9, float), rate) for ns, rate in ((a_ns, a), (b_ns, b)))
    edges = np.flatnonzero(np.diff(y.t) > GAP_S)
    starts, stops = y.t[np.concatenate([[0], edges + 1])], y.t[np.concatenate([edges, [len(y.t) - 1]])]
    t = np.concatenate([np.arange(p, q, STEP_S) for p, q in zip(starts, stops, strict=True)])
    t = t[y.covers(t)]
    if len(t) < LEAST_MOMENTS:
        return None
    told = y.rate(t)
    lags = np.arange(-round(LONGEST_S / STEP_S), round(LONGEST_S / STEP_S) + 1) * STEP_S
    r = np.full(len(lags), -1.0)
    for n, lag in enumerate(lags.tolist()):
        there = x.covers(t + lag)
        if there.sum() > max(LEAST_MOMENTS, 0.4 * len(t)):
            r[n] = _correlation(x.rate(t[there] + lag), told[there])
    best, middle = int(np.argmax(r)), len(lags) // 2
    if r[best] <= -1.0:
        return None
    there = x.covers(t + lags[best])
    mine, his = x.rate(t[there] + lags[best]), told[there]
    spread = float(his.std())
    if spread < LEAST or (spread < 3 * LEAST and float(mine.std()) < LEAST):
        return None
    slope = float(
        (mine - mine.mean()) @ (his - his.mean()) / max(float((his - his.mean()) @ (his - his.mean())), 1e-12)
    )
    return Agreement(float(r[best]), slope, float(lags[best] + _vertex(r, best) * STEP_S), float(r[middle]))


class _Turned:
    """Yaw over time, s and rad, from rates; and where it is known."""

    def __init__(self, t: Array, rate: Array) -> None:
        keep = np.concatenate([[True], np.diff(t) > 0])
        self.t, rate = t[keep], rate[keep]
        dt = np.diff(self.t)
        self.yaw = np.concatenate([[0.0], np.cumsum(np.where(dt < GAP_S, 0.5 * (rate[1:] + rate[:-1]) * dt, 0.0))])
        self.gaps = np.concatenate([[0], np.cumsum(dt >= GAP_S)])

    def covers(self, t: Array) -> NDArray[np.bool_]:
        """Moments (K,) about which there are samples all the time."""
        low, high = np.searchsorted(self.t, t - HALF_S) - 1, np.searchsorted(self.t, t + HALF_S)
        inside = (low >= 0) & (high < len(self.t))
        low, high = np.clip(low, 0, len(self.t) - 1), np.clip(high, 0, len(self.t) - 1)
        return np.asarray(inside & (self.gaps[low] == self.gaps[high]))

    def rate(self, t: Array) -> Array:
        """Mean rates (K,) about moments, rad/s."""
        return np.asarray(
            (np.interp(t + HALF_S, self.t, self.yaw) - np.interp(t - HALF_S, self.t, self.yaw)) / (2 * HALF_S)
        )


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
    good = streams.fix_sigma() < GOOD_FIX
    if good.sum() < 20:
        return np.zeros(0, np.int64), np.zeros(0)
    ns, enu = streams.fix_ns[good], streams.fixes_enu()[good, :2]
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
