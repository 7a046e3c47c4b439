"""What an estimator is given, and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, Datum, Stamps
from topograph.motion import Inertial, Motion, MotionConfig
from topograph.ranges import Count, NonNegative, Positive
from topograph.trees import Detections, Sightings


@dataclass(frozen=True, slots=True)
class EstimateConfig:
    """Noise and schedule; SI units.

    Attributes:
        keyframe_distance, keyframe_turn, keyframe_seconds: a new pose after so many m, rad, s.
        fix_floor: least standard deviations of a fix, horizontal and vertical, m.
        fix_correlation_s: time constant of GNSS errors: fixes nearer in time are not independent.
        heading_floor: least standard deviation of a heading, rad.
        huber, tukey: constants of the first and the last robust pass, in standard deviations.
        tree_floor: persistent error of a trunk's centre that no number of sightings removes, m.
        use_imu: IMU factors in the final solve.
        learn_scale: rescale trunk and GNSS noise by their residuals.
        most_sightings, quick_sightings: of one keyframe that are used, the surest first: where a hundred trunks are in
            view, the far ones add errors of their own kind and no information.
        iterations: most steps of a pass.
    """

    keyframe_distance: Positive = 0.5
    keyframe_turn: Positive = 0.2
    keyframe_seconds: Positive = 5.0
    fix_floor: tuple[Positive, Positive] = (0.01, 0.02)
    fix_correlation_s: Positive = 6.0
    heading_floor: Positive = 0.005
    huber: Positive = 1.345
    tukey: Positive = 4.685
    tree_floor: NonNegative = 0.003
    use_imu: bool = True
    learn_scale: bool = True
    most_sightings: Count = 30
    quick_sightings: Count = 25
    iterations: Count = 40


@dataclass(frozen=True, slots=True)
class Fixes:
    """G fixes, each tied to the keyframe nearest in time.

    Attributes:
        keyframe: (G,) index.
        keyframe_p_antenna: (G, 3) the antenna at the fix's own stamp, in the keyframe's base frame, m.
        map_p_antenna: (G, 3) ENU, m; `cov` (G, 3, 3).
        late: (G, 3) change of `keyframe_p_antenna` per second that the receiver's clock would run late, m/s.
    """

    keyframe: NDArray[np.int64]
    keyframe_p_antenna: Array
    map_p_antenna: Array
    cov: Array
    late: Array


@dataclass(frozen=True, slots=True)
class Headings:
    """H headings: `direction` (H, 3) in the keyframe's frame points to azimuth `yaw` (H,) with `sigma` (H,), rad."""

    keyframe: NDArray[np.int64]
    direction: Array
    yaw: Array
    sigma: Array


@dataclass(frozen=True, slots=True)
class KnownTrees:
    """Trees of an earlier map: landmarks (Q, 3) in the same frame, covariances (Q, 3, 3), and which tree of
    `sightings` each one is, (Q,), -1 where it was not seen; `single` (Q,) where it has one stem."""

    p: Array
    cov: Array
    tree: NDArray[np.int64]
    single: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Link:
    """A relative pose `a_T_b` (4, 4) between keyframes a and b, from a loop just recognised; a guide, no measurement."""

    a: int
    b: int
    a_T_b: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A run, ready for an estimator.

    Attributes:
        stamps_ns: (K,) keyframes.
        odom_T_robot: (K, 4, 4) dead reckoned.
        step_sigma: (K-1, 6) of the steps between keyframes: rotation (rad), translation (m).
        motion, motion_config: dead reckoning at any stamp, and its noise.
        inertial: IMU samples, or None.
        fixes, headings: may be empty.
        datum: origin of the map frame, or None without GNSS.
        detections: all trunks, for the estimator that associates for itself.
        sightings: associated trunks.
        n_trees: number of trees in `sightings`.
        placed: the fixes and headings are places in a known map that the localizer found, no GNSS.
        tree_ids: (n_trees,) what each is called from pass to pass: the first of its tracks, or the known tree that it is. The graph's
            keys are made of it.
        pose_sigma: when the path is known beforehand (`start`), its deviation (m, rad); else None.
        start: (K, 4, 4) first guess of `map_T_robot`, or None.
        known: trees that an earlier map knows, or None.
        up: (K, 3) mean axis of the trunks at each keyframe, in its base frame; NaN where there are too few.
        up_sigma: (K,) rad.
        link: guides a quick solve across a loop; never part of a final one.
    """

    stamps_ns: Stamps
    odom_T_robot: Array
    step_sigma: Array
    motion: Motion
    motion_config: MotionConfig
    inertial: Inertial | None
    fixes: Fixes
    headings: Headings
    datum: Datum | None
    detections: Detections
    sightings: Sightings
    n_trees: int
    pose_sigma: float | None = None
    start: Array | None = None
    known: KnownTrees | None = None
    up: Array | None = None
    up_sigma: Array | None = None
    link: Link | None = None
    placed: bool = False
    tree_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def names(self) -> NDArray[np.int64]:
        """`tree_ids`; where nobody gave any, trees are called by their number."""
        return self.tree_ids if len(self.tree_ids) == self.n_trees else np.arange(self.n_trees)


@dataclass(frozen=True, slots=True, kw_only=True)
class Offset:
    """A calibration that was taken as given, tested against the residuals.

    Attributes:
        name: "fix clock", "trunk clock" (s), "antenna" (x, y in the base's frame, m), "trunk mount" (x, y), "trunk yaw" (rad),
            "wheel scale" (share).
        value, sigma: (q,) what it would have to be off by, and the standard deviation of that.
        gain: by how much the sum of squared whitened residuals would fall.
    """

    name: str
    value: Array
    sigma: Array
    gain: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Path, trees and what is known of their errors.

    Attributes:
        stamps_ns, map_T_robot: (K,), (K, 4, 4).
        trees: (T, 3) landmarks, m (at the height the detections state).
        tree_cov: (T, 3, 3) marginal covariances, m²; NaN when the estimator has none.
        joint: (3T, 3T) covariance of all trees, or None.
        datum_cov: (3, 3) common error of the whole map in the ENU frame, m²; contained in `tree_cov`.
        tree: (N,) tree of each detection, -1 for none.
        weights: (M,) robust weights of the sightings.
        residuals: factor type -> normalised residuals (R,); `residual_ns`: factor type -> when each is of, (R,).
        scales: factor type -> factor that its noise was multiplied with; "trunks alike": the part of the trunks' that is owed to
            neighbours erring alike.
        offsets: what a clock, a mounting or the wheels' scale would have to be off by to explain the residuals best.
        seconds: what it took.
    """

    stamps_ns: Stamps
    map_T_robot: Array
    trees: Array
    tree_cov: Array
    joint: Array | None
    datum_cov: Array
    tree: NDArray[np.int64]
    weights: Array
    residuals: dict[str, Array] = field(default_factory=dict)
    residual_ns: dict[str, Stamps] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    offsets: tuple[Offset, ...] = ()
