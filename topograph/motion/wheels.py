"""Wheels against fixes: their scale, and where they slip. Only where GNSS is good to a few centimetres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening, maximum_filter1d

from topograph.geometry import Array, Stamps, interpolate, transform, wrap
from topograph.session import Streams

GOOD_FIX = 0.15
"""Horizontal sigma up to which fixes tell of a slip, m."""
LONGEST_S = 1.5
"""Between two fixes that tell a speed."""
WINDOW_S = 1.0
"""Over which ways are compared."""
SLIP = (0.12, 0.14)
"""Difference of speeds that is a slip: m/s, and share of the faster one. Reflections make fixes wander by up to 0.2 m/s; slips
below that are for the graph, where the trunks speak too."""
FASTEST = 12.0
"""A field robot's or tractor's speed, m/s; faster fixes are jumps."""
CALM = 0.2
"""Steps of fixes whose speeds scatter by more, m/s and beyond their noise, are jumps."""
SURE = 5.0
"""Deviations by which the way between two fixes has to differ from the wheels'."""
SCALE_WINDOW_S = 3.0
SCALE = 0.03
"""Wheels whose scale is off by more are corrected; by less is what the graph's noise allows for."""
CLEAR = 0.15
"""Windows that scatter by more are of fixes that jump, and tell nothing of the wheels."""
LEAST_WINDOWS = 15
EVEN_S = 4.0
"""Before and after a break, in which wheels and fixes go together."""
BREAK, EVEN, LEAST_WAY = 0.3, 6.0, 0.5
"""They part by so many m, and so many times what they part by before and after, where those ways reach so far about their middle, m RMS."""
SLIP_SIGMA = 0.3
"""Share of the difference that is not known after the fixes' speed has been put in its place."""


@dataclass(frozen=True, slots=True)
class WheelCheck:
    """What fixes say of wheels.

    Attributes:
        factor: (M,) what each step of the wheels is multiplied with.
        advance: (M,) m, forward, that is added to it where wheels stood and the robot did not.
        doubt: (M,) m, standard deviation of the step for the slip alone.
        scale: of the wheels, 1 where it was not corrected.
        slips: (S, 3) from, to (s since the first odometry) and mean difference of speed, m/s.
        breaks: (B, 3) time (s since the first odometry) at which wheels and fixes part in one step, by how much, m and rad.
        broken: (M, 2) m and rad, standard deviations of each step for such a break.
    """

    factor: Array
    advance: Array
    doubt: Array
    scale: float
    slips: Array
    breaks: Array = field(default_factory=lambda: np.zeros((0, 3)))
    broken: Array = field(default_factory=lambda: np.zeros((0, 2)))


def against_fixes(streams: Streams, odom_T_robot: Array, robot_p_antenna: Array) -> WheelCheck:
    """Compare dead-reckoned poses (O, 4, 4) at odometry's stamps with the fixes."""
    ns = streams.odometry_ns
    steps = len(ns) - 1
    nothing = WheelCheck(np.ones(steps), np.zeros(steps), np.zeros(steps), 1.0, np.zeros((0, 3)))
    good = (streams.fix_sigma() < GOOD_FIX) & (streams.fix_ns >= ns[0]) & (streams.fix_ns <= ns[-1])
    if good.sum() < LEAST_WINDOWS:
        return nothing
    at = streams.fix_ns[good]
    enu, sigma = streams.fixes_enu()[good, :2], streams.fix_sigma()[good]
    poses = interpolate(ns, odom_T_robot, at)
    antenna = transform(poses, robot_p_antenna)[:, :2]
    scale = _scale(at, enu, antenna, sigma)
    dt = np.diff(at) * 1e-9
    step = float(np.median(dt))
    half = max(1, round(0.5 * WINDOW_S / max(step, 1e-3)))
    if len(at) < LEAST_WINDOWS + 2 * half:
        return nothing
    k = np.arange(half, len(at) - half)
    a, b = k - half, k + half
    seconds = (at[b] - at[a]) * 1e-9
    # Twice: the way between a window's ends, which noise does not lengthen, and the median of its steps, which no jump moves.
    noise = np.hypot(sigma[a], sigma[b])
    way = np.linalg.norm(enu[b] - enu[a], axis=1)
    base = scale * (poses[b, :2, 3] - poses[a, :2, 3])
    turn = (antenna[b] - antenna[a]) - base / scale  # what the antenna does for the turn alone
    told = np.linalg.norm(base + turn, axis=1)
    apart = np.abs(way - told)
    slipping = (apart > SURE * noise) & (apart > (SLIP[0] + SLIP[1] * np.maximum(way, told) / seconds) * seconds)
    speed = np.linalg.norm(np.diff(enu, axis=0), axis=1) / np.maximum(dt, 1e-3)
    wheel = np.linalg.norm(np.diff(antenna, axis=0), axis=1) / np.maximum(dt, 1e-3)
    rows = a[:, None] + np.arange(2 * half)
    # What noise alone makes of a step's length (median of a Rayleigh distribution).
    still = 1.18 * np.median(np.hypot(sigma[1:], sigma[:-1])[rows] / np.maximum(dt[rows], 1e-3), axis=1)
    middle = np.sqrt(np.maximum(np.median(speed[rows], axis=1) ** 2 - still**2, 0.0))
    slipping &= np.abs(middle - scale * np.mean(wheel[rows], axis=1)) > 0.5 * apart / seconds
    scatter = 1.4826 * np.median(np.abs(speed[rows] - np.median(speed[rows], axis=1)[:, None]), axis=1)
    slipping &= scatter < CALM + 3.0 * still
    slipping &= (
        (np.abs(middle * seconds - way) < 0.5 * apart + 3.0 * noise) & (middle < FASTEST) & (seconds < 2.0 * LONGEST_S)
    )
    slipping = _lasting(slipping)
    length, reach = np.linalg.norm(base, axis=1), np.sqrt(np.maximum(way**2 - 2.0 * noise**2, 0.0))
    blocked = length < 0.1 * reach
    by = np.where(blocked, 0.0, _factor(base, turn, reach))
    centre = ns[:-1] + np.diff(ns) // 2
    where = at[k]
    inside = np.interp(centre, where, slipping.astype(float), left=0.0, right=0.0) > 0
    factor = np.full(steps, scale)
    factor[inside] *= np.interp(centre, where, by)[inside]
    stands = np.interp(centre, where, blocked.astype(float)) > 0.5
    forward = np.interp(centre, where, reach / seconds) * np.diff(ns) * 1e-9
    factor[inside & stands] = scale
    advance = np.where(inside & stands, forward, 0.0)
    off = np.interp(centre, where, (way - told) / seconds)
    doubt = np.where(inside, (SLIP_SIGMA * np.abs(off) + 0.05) * np.diff(ns) * 1e-9, 0.0)
    told_breaks, broken = _broken(ns, at, ~inside, breaks(at, enu, antenna, sigma))
    return WheelCheck(factor, advance, doubt, scale, _spans(centre, inside, off, ns[0]), told_breaks, broken)


def _broken(
    ns: Stamps, at: Stamps, free: NDArray[np.bool_], found: list[tuple[int, float, float]]
) -> tuple[Array, Array]:
    """`WheelCheck.breaks` and `.broken` of those found between fixes at `at`, in steps of the wheels (M,) that are `free` of slips."""
    broken, parts = np.zeros((len(free), 2)), []
    for last, metres, radians in found:
        mine = (ns[1:] > at[last]) & (ns[:-1] < at[last + 1]) & free
        if mine.any():
            broken[mine] = np.array([metres, radians]) / mine.sum()
            parts.append((float(at[last] - ns[0]) * 1e-9, metres, radians))
    return np.array(parts, float).reshape(-1, 3), broken


def breaks(at: Stamps, enu: Array, antenna: Array, sigma: Array) -> list[tuple[int, float, float]]:
    """(k, m, rad): between the fixes k and k + 1 the way of the wheels (N, 2) and the fixes (N, 2) part in one step, though before and
    after it they are one and the same. Either may be the one that jumped: the step tells nothing, the trees have to.
    """
    n = max(5, round(EVEN_S / max(float(np.median(np.diff(at))) * 1e-9, 1e-3)))
    if len(at) < 2 * n:
        return []
    turn, middle, target, rms, reach = _fits(antenna, enu, n)
    before, after = np.arange(len(at) - 2 * n + 1), np.arange(n, len(at) - n + 1)
    k = before + n - 1
    mid = 0.5 * (antenna[k] + antenna[k + 1])
    apart = np.linalg.norm(_put(turn, middle, target, before, mid) - _put(turn, middle, target, after, mid), axis=1)
    uneven = np.maximum(np.maximum(rms[before], rms[after]), sigma[k])
    sharp = apart / uneven  # beside the break itself, a window that holds it fits badly, and may part by more
    found = (apart > BREAK) & (sharp > EVEN) & (np.minimum(reach[before], reach[after]) > LEAST_WAY)
    found &= (np.diff(at)[k] < LONGEST_S * 1e9) & (sharp >= maximum_filter1d(sharp, 2 * n + 1))
    turned = np.abs(wrap(turn[after] - turn[before]))
    return [(int(k[i]), float(apart[i]), float(turned[i])) for i in np.flatnonzero(found)]


def _fits(source: Array, target: Array, n: int) -> tuple[Array, Array, Array, Array, Array]:
    """Of each window of `n` points: the turn (W,), rad, and the middles (W, 2) that lay `source` (N, 2) onto `target` (N, 2), what is left,
    m RMS (W,), and how far the source reaches about its middle, m RMS (W,)."""
    shift_s, shift_t = source[0], target[0]
    s, t = source - shift_s, target - shift_t
    columns = np.column_stack([s, t, np.sum(s * t, axis=1), s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0], np.sum(s * s, axis=1), np.sum(t * t, axis=1)])  # fmt: skip
    total = np.cumsum(np.concatenate([np.zeros((1, columns.shape[1])), columns]), axis=0)
    m = (total[n:] - total[:-n]) / n
    a, b = m[:, :2], m[:, 2:4]
    dot = m[:, 4] - np.sum(a * b, axis=1)
    cross = m[:, 5] - (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    spread_s, spread_t = m[:, 6] - np.sum(a * a, axis=1), m[:, 7] - np.sum(b * b, axis=1)
    left = spread_s + spread_t - 2.0 * np.hypot(dot, cross)
    root = [np.sqrt(np.maximum(v, 0.0)) for v in (left, spread_s)]
    return np.arctan2(cross, dot), a + shift_s, b + shift_t, root[0], root[1]


def _put(turn: Array, middle: Array, target: Array, window: NDArray[np.int64], points: Array) -> Array:
    """Where the fits of `window` (K,) put `points` (K, 2)."""
    c, s = np.cos(turn[window]), np.sin(turn[window])
    x, y = (points - middle[window]).T
    return np.stack([c * x - s * y, s * x + c * y], axis=1) + target[window]


def _factor(base: Array, turn: Array, reach: Array) -> Array:
    """What the base's moves (K, 2) have to be multiplied with for the antenna to get as far as `reach` (K,); `turn` (K, 2) is what
    it does beside: |f base + turn| = reach, the root nearest to 1.
    """
    A = np.maximum(np.sum(base**2, axis=1), 1e-9)
    B, C = np.sum(base * turn, axis=1), np.sum(turn**2, axis=1) - reach**2
    root = np.sqrt(np.maximum(B**2 - A * C, 0.0))
    both = np.stack([(-B + root) / A, (-B - root) / A])
    near = np.abs(both - 1.0).argmin(axis=0)
    return np.asarray(np.clip(both[near, np.arange(len(A))], 0.0, 20.0))


def _scale(at: Stamps, enu: Array, antenna: Array, sigma: Array) -> float:
    """What wheels have to be multiplied with, from the middle of many windows; 1 where that is near or not known."""
    later = np.searchsorted(at, at + int(SCALE_WINDOW_S * 1e9))
    i = np.flatnonzero(later < len(at))
    j = later[i]
    a, b = np.linalg.norm(enu[j] - enu[i], axis=1), np.linalg.norm(antenna[j] - antenna[i], axis=1)
    far = (np.minimum(a, b) > 0.5) & (np.minimum(a, b) > 10.0 * np.hypot(sigma[i], sigma[j]))
    if far.sum() < LEAST_WINDOWS:
        return 1.0
    ratio = (a / np.maximum(b, 1e-9))[far]
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    return middle if abs(middle - 1.0) > max(SCALE, spread) and spread < CLEAR and 0.2 < middle < 5.0 else 1.0


def _lasting(slipping: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Slips of at least two neighbours, widened by one on each side."""
    return np.asarray(binary_dilation(binary_opening(slipping, np.ones(2, bool)), np.ones(3, bool)))


def _spans(at: Stamps, inside: NDArray[np.bool_], off: Array, first: int) -> Array:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    rows = [
        ((at[a] - first) * 1e-9, (at[b - 1] - first) * 1e-9, float(off[a:b].mean())) for a, b in edges.reshape(-1, 2)
    ]
    return np.array(rows, float).reshape(-1, 3)
