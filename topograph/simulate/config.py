"""What is simulated. Nothing of this reaches the estimator; the bags and the truth do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class OrchardConfig:
    """An orchard's design; lengths in m, angles in rad.

    Attributes:
        layout: "grid", "irregular" (hexagonal with large jitter), "hedgerow" (narrow in the row) or "wild" (anywhere, no
            nearer than half of `tree_spacing`).
        rows, columns: trees per direction; `columns` counts along the row.
        row_spacing, tree_spacing, jitter: distances; sigma of the planting error.
        gaps: share of places without a tree.
        slope: of the ramp, downhill along the rows; `roughness` is the sigma of the ground's waves.
        lean: sigma of the trunks' tilt.
        multi_stem: share of trees that divide below 0.6 m.
        diameter: smallest and largest trunk diameter.
        canopy_base: smallest and largest height of the first branches.
        grass, weeds, suckers: height of grass; weeds per m²; share of trees with suckers.
        posts, poles, people, walkers, vehicles, hedges: how many.
        crown: share of the leaves that a full crown has; 0: dormant, bare branches.
        branches: dead branches and stubs on each trunk below the crown.
        bend: sigma of the change of direction per half metre of trunk, rad.
        flare: radius at the ground over the radius at 0.8 m, less 1; `lobes`: share of trunks that are no circle.
        mound: height of the mound that each tree stands on.
        shrubs: bushes and saplings per m² that are no trees.
        trellis: distance of posts with wires in the rows (0: none).
        walls, cars, fences, lamps, signs: of a yard around.
        companions: people who walk beside the robot; `beside` where, in the robot's frame (x, y).
    """

    layout: str = "grid"
    rows: int = 4
    columns: int = 6
    row_spacing: float = 6.0
    tree_spacing: float = 6.0
    jitter: float = 0.25
    gaps: float = 0.04
    slope: float = 0.14
    roughness: float = 0.05
    lean: float = 0.08
    multi_stem: float = 0.15
    diameter: tuple[float, float] = (0.18, 0.42)
    canopy_base: tuple[float, float] = (1.2, 2.0)
    grass: float = 0.15
    weeds: float = 0.06
    suckers: float = 0.3
    posts: int = 10
    poles: int = 2
    people: int = 3
    walkers: int = 2
    vehicles: int = 1
    hedges: int = 1
    crown: float = 1.0
    branches: int = 0
    bend: float = 0.0
    flare: float = 0.0
    lobes: float = 0.0
    mound: float = 0.0
    shrubs: float = 0.0
    trellis: float = 0.0
    walls: int = 0
    cars: int = 0
    fences: int = 0
    lamps: int = 0
    signs: int = 0
    companions: int = 0
    beside: tuple[float, float] = (-1.2, 1.0)


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The robot's sensors and their faults; SI units.

    Attributes:
        rings, fov: number of lasers; lowest and highest elevation, rad; `elevation`: each laser's, where not evenly spread.
        mount: base_T_lidar as x, y, z, roll, pitch, yaw; None: that of `sensors.MOUNTS`.
        ring_bias: sigma of each laser's constant range error; `from_top`: rings are counted from the top.
        mast: a mast stands on the robot at (-0.6, 0.3); `twice`: each return is reported twice.
        sweep_hz, columns: sweeps per second that are recorded; firings per sweep. A LiDAR turns at `SLOWEST_HZ` at least: where fewer
            sweeps are recorded, some are left out, none is slower.
        range_sigma, max_range, dropout: of one return; `bark` scales the roughness of trunks.
        divergence: half angle of the beam, rad (mixed pixels at edges).
        gyro_density, accel_density, gyro_bias, accel_bias, vibration: XSens MTi-300 (thesis 5.1) on a rolling robot.
        wheel_scale, yaw_scale, slip: sigma of the scale errors; slip events per minute.
        gnss: "rtk", "degraded" (float, multipath with optimistic covariance, 60 s outages), "float" or "none".
        heading_sigma: of the dual-antenna heading; 0 writes none.
        detections: write trunk detections (`vision_msgs/Detection3DArray`) in place of clouds.
        compression: "none", "lz4" (ROS 1) or "zstd" (mcap).
    """

    rings: int = 16
    fov: tuple[float, float] = (-0.2618, 0.2618)
    elevation: tuple[float, ...] = ()
    mount: tuple[float, ...] | None = None
    ring_bias: float = 0.0
    from_top: bool = False
    mast: bool = False
    twice: bool = False
    sweep_hz: float = 10.0
    columns: int = 1808
    range_sigma: float = 0.03
    max_range: float = 60.0
    dropout: float = 0.02
    bark: float = 1.0
    divergence: float = 0.0015
    imu_hz: float = 100.0
    gyro_density: float = 1.75e-4
    accel_density: float = 6e-4
    gyro_bias: float = 2e-3
    accel_bias: float = 2e-2
    vibration: float = 0.25
    wheel_hz: float = 20.0
    wheel_scale: float = 0.01
    yaw_scale: float = 0.06
    slip: float = 1.5
    gnss: str = "rtk"
    gnss_hz: float = 5.0
    heading_sigma: float = 0.006
    detections: bool = False
    compression: str = "none"

    @property
    def sweep_s(self) -> float:
        """How long a sweep takes."""
        return 1.0 / max(self.sweep_hz, SLOWEST_HZ)


SLOWEST_HZ = 5.0
"""Turns a second of the slowest LiDAR (VLP-16: 5 to 20)."""


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """How the robot is driven.

    Attributes:
        run: 1 rows downhill and back, 2 the same the other way, 3 zigzag around the trees (thesis 5.3).
        speed: m/s.
        stop_every: stop-and-go distance, m (0: never); `stop_s` the pause.
        scans_at_stops: clouds are taken while the robot stands, two a second, as in the thesis (5.3).
        laps: how often the run is driven.
        longest_s: the drive is cut there.
    """

    run: int = 1
    speed: float = 0.9
    stop_every: float = 0.0
    stop_s: float = 2.0
    scans_at_stops: bool = False
    laps: int = 1
    longest_s: float = 3600.0


DESIGNS: dict[str, OrchardConfig] = {
    "grid": OrchardConfig(),
    "olive": OrchardConfig(
        layout="irregular",
        rows=4,
        columns=6,
        row_spacing=6.1,
        tree_spacing=7.0,
        jitter=0.8,
        gaps=0.1,
        lean=0.14,
        multi_stem=0.3,
        diameter=(0.16, 0.5),
        canopy_base=(1.1, 1.7),
    ),
    "steep": OrchardConfig(
        layout="irregular",
        slope=0.21,
        roughness=0.1,
        jitter=0.6,
        gaps=0.1,
        grass=0.25,
        weeds=0.15,
        suckers=0.45,
        lean=0.12,
        multi_stem=0.2,
    ),
    "gentle": OrchardConfig(
        slope=0.07, roughness=0.03, grass=0.1, weeds=0.03, suckers=0.15, lean=0.05, multi_stem=0.05
    ),
    "hedgerow": OrchardConfig(
        layout="hedgerow",
        rows=4,
        columns=16,
        row_spacing=4.5,
        tree_spacing=1.8,
        jitter=0.08,
        gaps=0.05,
        lean=0.05,
        multi_stem=0.0,
        diameter=(0.08, 0.16),
        canopy_base=(0.8, 1.2),
        posts=16,
        slope=0.09,
    ),
    "young": OrchardConfig(
        rows=5,
        columns=10,
        row_spacing=4.0,
        tree_spacing=3.0,
        jitter=0.08,
        lean=0.06,
        multi_stem=0.0,
        diameter=(0.045, 0.1),
        canopy_base=(0.7, 1.1),
        crown=0.35,
        grass=0.1,
        suckers=0.0,
        mound=0.1,
        slope=0.06,
    ),
    "trellis": OrchardConfig(
        layout="hedgerow",
        rows=4,
        columns=20,
        row_spacing=3.5,
        tree_spacing=1.2,
        jitter=0.05,
        gaps=0.03,
        lean=0.05,
        multi_stem=0.0,
        diameter=(0.06, 0.12),
        canopy_base=(0.7, 1.0),
        crown=0.6,
        posts=2,
        trellis=6.0,
        slope=0.08,
        suckers=0.1,
    ),
    "old_olive": OrchardConfig(
        layout="irregular",
        rows=3,
        columns=5,
        row_spacing=8.0,
        tree_spacing=9.0,
        jitter=1.0,
        gaps=0.05,
        lean=0.16,
        multi_stem=0.35,
        diameter=(0.5, 1.1),
        canopy_base=(1.2, 2.0),
        flare=0.25,
        lobes=0.6,
        bend=0.05,
        mound=0.15,
    ),
    "bare": OrchardConfig(
        rows=4,
        columns=7,
        crown=0.0,
        canopy_base=(2.5, 5.0),
        diameter=(0.1, 0.35),
        multi_stem=0.05,
        suckers=0.05,
        branches=4,
        bend=0.02,
    ),
    "forest": OrchardConfig(
        layout="wild",
        rows=6,
        columns=8,
        row_spacing=4.0,
        tree_spacing=4.0,
        jitter=0.0,
        gaps=0.0,
        lean=0.05,
        multi_stem=0.05,
        diameter=(0.12, 0.5),
        canopy_base=(4.0, 8.0),
        branches=10,
        bend=0.02,
        flare=0.15,
        shrubs=0.06,
        weeds=0.1,
        posts=0,
        poles=0,
        vehicles=0,
        hedges=0,
        suckers=0.1,
        roughness=0.08,
    ),
    "yard": OrchardConfig(
        rows=3,
        columns=5,
        row_spacing=7.0,
        tree_spacing=8.0,
        slope=0.02,
        canopy_base=(1.8, 3.5),
        multi_stem=0.05,
        walls=4,
        cars=8,
        fences=2,
        lamps=4,
        signs=5,
        people=6,
        walkers=4,
        vehicles=2,
        hedges=2,
        weeds=0.01,
        grass=0.03,
    ),
}
