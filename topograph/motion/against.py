"""Gyro, wheels and the map's poses held against each other while driving: whom a live robot may believe."""

from __future__ import annotations

from collections import deque

import numpy as np

from topograph.geometry import Array, wrap

BLOCK_S, BLOCKS, FEW = 1.0, 20, 4
"""Motion is compared over stretches of this length, the last so many, at least so few."""
TURNS = 0.08
"""Deviation of the turns of a stretch from which on they tell how gyro and wheels go together, rad."""
ALIKE, SLOPES = 0.9, (0.5, 2.0)
"""Correlation and slope of wheels on gyro that are as they should be: wheels that skid in turns are off by a steady factor."""
DEGREES = (1 / 80.0, 1 / 40.0)
"""The same slope of a gyro that speaks in degrees."""
WRONG_TURN = 0.03
"""A gyro that differs more from the map's headings, rad in a stretch, is not used while the wheels are twice as near to them."""
FAR = 0.3
"""A stretch of fewer metres says nothing of the wheels' scale."""
SCALE_SIGMA, SCALE_WALK, PLACE_SIGMA = 0.1, 0.002, 0.06
"""Of the wheels' scale before anything is known; how it wanders in a stretch; of a stretch's ends on the map, m."""
SCALES = (0.5, 2.0)


class Against:
    """What the last stretches say of the sensors.

    Attributes:
        gyro_is_wrong: the map's headings are with the wheels.
        degrees: the gyro speaks in degrees.
        scale: metres on the map in one of the wheels'.
    """

    def __init__(self) -> None:
        self.gyro_is_wrong = False
        self.degrees = False
        self.scale = 1.0
        self._variance = SCALE_SIGMA**2
        self._blocks: deque[tuple[float, float, float]] = deque(maxlen=BLOCKS)
        self._lengths: deque[float] = deque(maxlen=BLOCKS)  # of the stretches, s
        self._open = np.zeros(
            6
        )  # gyro, wheels (rad), seconds, way of the wheels in the frame of the stretch's begin (x, y), its length
        self._begin: Array | None = None  # pose on the map (3,) where the stretch began, if there is one

    def take(self, gyro: float, wheels: float, step: Array, seconds: float) -> float:
        """One leg (0 s: the wheels do not cover it), `step` (2,) as the wheels have it; how far the gyro's rate is to be doubted,
        rad/s."""
        if self._open[2] >= BLOCK_S:
            self._close(None)  # no map said where it ended
        if seconds > 0:
            c, s = np.cos(self._open[0]), np.sin(self._open[0])
            way = np.array([c * step[0] - s * step[1], s * step[0] + c * step[1]])
            self._open += (gyro, wheels, seconds, way[0], way[1], float(np.hypot(*way)))
        else:
            self.forget()
        return self._doubt()

    def forget(self) -> None:
        """The stretch that runs teaches nothing: its wheels or its gyro are known to be wrong."""
        self._begin, self._open[:] = None, 0.0

    def see(self, pose: Array) -> None:
        """The pose (3,) on the map at the end of the last leg: x, y (m) and heading (rad)."""
        if self._begin is None:
            self._begin, self._open[:] = pose, 0.0
        elif self._open[2] >= BLOCK_S:
            self._close(pose)

    def _close(self, pose: Array | None) -> None:
        turn = float("nan")
        if self._begin is not None and pose is not None:
            turn = float(wrap(pose[2] - self._begin[2]))
            self._learn_scale(float(np.hypot(*(pose[:2] - self._begin[:2]))), float(np.hypot(*self._open[3:5])))
        self._blocks.append((float(self._open[0]), float(self._open[1]), turn))
        self._lengths.append(float(self._open[2]))
        self._open[:] = 0.0
        self._begin = pose
        b = np.array(self._blocks)
        known = b[np.isfinite(b[:, 2])]
        if len(known) >= FEW:
            by_gyro, by_wheels = (float(np.sqrt(np.mean((known[:, k] - known[:, 2]) ** 2))) for k in (0, 1))
            self.gyro_is_wrong = by_gyro > WRONG_TURN and by_gyro > 2.0 * by_wheels

    def _learn_scale(self, on_map: float, wheels: float) -> None:
        """Kalman update of the scale by one stretch; `wheels` is already scaled."""
        if wheels < FAR or on_map > 3.0 * wheels:
            return
        raw = wheels / self.scale
        self._variance += SCALE_WALK**2
        S = raw**2 * self._variance + 2 * PLACE_SIGMA**2
        if (on_map - wheels) ** 2 > 16.0 * S:
            return  # found again elsewhere
        gain = raw * self._variance / S
        self.scale = float(np.clip(self.scale + gain * (on_map - wheels), *SCALES))
        self._variance *= 1.0 - gain * raw

    def _doubt(self) -> float:
        if len(self._blocks) < FEW:
            return 0.0
        gyro, wheels, _ = np.array(self._blocks).T
        if max(gyro.std(), wheels.std()) > TURNS and min(gyro.std(), wheels.std()) > 0:
            correlation, slope = float(np.corrcoef(gyro, wheels)[0, 1]), float(wheels.std() / gyro.std())
            if correlation > ALIKE and SLOPES[0] < slope < SLOPES[1]:
                return 0.0
            if correlation > ALIKE and DEGREES[0] < slope < DEGREES[1] and not self.degrees:
                self.degrees = True
                self._blocks.clear()
                self._lengths.clear()
                return 0.0
        off = float(np.sqrt(np.mean((gyro - wheels) ** 2)) / np.mean(self._lengths))
        return off if off > WRONG_TURN else 0.0
