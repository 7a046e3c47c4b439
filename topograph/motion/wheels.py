"""Wheels against fixes: their scale, and where they slip. Only where GNSS is good to a few centimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening

from topograph.geometry import Array, Datum, Stamps, interpolate, transform, wrap, yaw_of
from topograph.motion.streams import Streams

GOOD_FIX = 0.15
"""Horizontal sigma up to which fixes tell of a slip, m."""
LONGEST_S = 1.5
"""Between two fixes that tell a speed."""
WINDOW_S = 1.0
"""Over which speeds are compared: the median of the fixes' steps, so that a jump of GNSS is no slip."""
SLIP = (0.12, 0.14)
"""Difference of speeds that is a slip: m/s, and share of the faster one. Reflections make fixes wander by up to 0.2 m/s; slips
below that are for the graph, where the trunks speak too."""
CALM = (0.15, 3.0)
"""Fixes whose speeds within a window differ by more, m/s and times their noise, tell nothing of wheels."""
FASTEST = 12.0
"""A field robot's or tractor's speed, m/s; faster fixes are jumps."""
SCALE_WINDOW_S = 3.0
SCALE = 0.03
"""Wheels whose scale is off by more are corrected; by less is what the graph's noise allows for."""
LEAST_WINDOWS = 15
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
    """

    factor: Array
    advance: Array
    doubt: Array
    scale: float
    slips: Array


def against_fixes(streams: Streams, odom_T_robot: Array, robot_p_antenna: Array) -> WheelCheck:
    """Compare dead-reckoned poses (O, 4, 4) at odometry's stamps with the fixes."""
    ns = streams.odometry_ns
    steps = len(ns) - 1
    nothing = WheelCheck(np.ones(steps), np.zeros(steps), np.zeros(steps), 1.0, np.zeros((0, 3)))
    good = (
        np.sqrt(streams.fix_cov[:, [0, 1], [0, 1]].max(axis=1)) < GOOD_FIX if len(streams.fix_ns) else np.zeros(0, bool)
    )
    good &= (streams.fix_ns >= ns[0]) & (streams.fix_ns <= ns[-1])
    if good.sum() < LEAST_WINDOWS:
        return nothing
    at = streams.fix_ns[good]
    fixes = streams.lat_lon_h[good]
    enu = Datum(*(float(v) for v in np.median(fixes, axis=0))).to_enu(fixes)[:, :2]
    sigma = np.sqrt(streams.fix_cov[good][:, [0, 1], [0, 1]].max(axis=1))
    poses = interpolate(ns, odom_T_robot, at)
    antenna = transform(poses, robot_p_antenna)[:, :2]
    scale = _scale(at, enu, antenna, sigma)
    dt = np.diff(at) * 1e-9
    near = (dt > 1e-3) & (dt < LONGEST_S)
    if near.sum() < LEAST_WINDOWS:
        return nothing
    middle = (at[:-1] + np.diff(at) // 2)[near]
    # Speeds of the base: what the antenna does for the turn alone is taken off.
    turn = wrap(np.diff(yaw_of(poses)))[near] / dt[near]
    v_fix = np.linalg.norm(np.diff(enu, axis=0), axis=1)[near] / dt[near]
    v_fix = np.sqrt(np.maximum(v_fix**2 - (turn * robot_p_antenna[0]) ** 2, 0.0)) + turn * robot_p_antenna[1]
    v_fix = np.abs(v_fix)
    v_wheel = scale * np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)[near] / dt[near]
    noise = np.hypot(sigma[1:], sigma[:-1])[near] / dt[near]
    v_fix, v_wheel, spread, sure = _windowed(middle, v_fix, v_wheel, noise)
    slipping = np.abs(v_fix - v_wheel) > SLIP[0] + SLIP[1] * np.maximum(v_fix, v_wheel) + 2.0 * sure
    slipping &= (spread < CALM[0] + CALM[1] * noise) & (v_fix < FASTEST)
    slipping = _lasting(slipping)
    seconds = np.diff(ns) * 1e-9
    centre = ns[:-1] + np.diff(ns) // 2
    inside = np.interp(centre, middle, slipping.astype(float), left=0.0, right=0.0) > 0
    told, wheel = np.interp(centre, middle, v_fix), np.interp(centre, middle, v_wheel)
    factor = np.full(steps, scale)
    stands = inside & (wheel < 0.05)
    factor[inside & ~stands] *= np.clip(told / np.maximum(wheel, 1e-6), 0.0, 20.0)[inside & ~stands]
    advance = np.where(stands, told * seconds, 0.0)
    doubt = np.where(inside, (SLIP_SIGMA * np.abs(told - wheel) + 0.05) * seconds, 0.0)
    return WheelCheck(factor, advance, doubt, scale, _spans(centre, inside, told - wheel, ns[0]))


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
    return middle if abs(middle - 1.0) > max(SCALE, spread) and 0.2 < middle < 5.0 else 1.0


def _windowed(at: Stamps, v_fix: Array, v_wheel: Array, noise: Array) -> tuple[Array, Array, Array, Array]:
    """Around each step, at least five: median of the fixes' speeds, mean of the wheels', the fixes' spread, noise of the median."""
    step = float(np.median(np.diff(at))) * 1e-9
    half = max(2, round(0.5 * WINDOW_S / max(step, 1e-3)))
    rows = np.clip(np.arange(len(at))[:, None] + np.arange(-half, half + 1), 0, len(at) - 1)
    middle = np.median(v_fix[rows], axis=1)
    spread = 1.4826 * np.median(np.abs(v_fix[rows] - middle[:, None]), axis=1)
    return middle, np.mean(v_wheel[rows], axis=1), spread, noise / np.sqrt(2 * half + 1)


def _lasting(slipping: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Slips of at least two neighbours, widened by one on each side."""
    return np.asarray(binary_dilation(binary_opening(slipping, np.ones(2, bool)), np.ones(3, bool)))


def _spans(at: Stamps, inside: NDArray[np.bool_], off: Array, first: int) -> Array:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    rows = [
        ((at[a] - first) * 1e-9, (at[b - 1] - first) * 1e-9, float(off[a:b].mean())) for a, b in edges.reshape(-1, 2)
    ]
    return np.array(rows, float).reshape(-1, 3)
