"""What is simulated. Nothing of this reaches the estimator; the bags and the truth do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class OrchardConfig:
    """An orchard's design; lengths in m, angles in rad.

    Attributes:
        layout: "grid", "irregular" (hexagonal with large jitter) or "hedgerow" (narrow in the row).
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


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The robot's sensors and their faults; SI units.

    Attributes:
        rings, fov: number of lasers; lowest and highest elevation, rad.
        sweep_hz, columns: sweeps per second; firings per sweep.
        range_sigma, max_range, dropout: of one return.
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
    sweep_hz: float = 10.0
    columns: int = 1808
    range_sigma: float = 0.03
    max_range: float = 60.0
    dropout: float = 0.02
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


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """How the robot is driven.

    Attributes:
        run: 1 rows downhill and back, 2 the same the other way, 3 zigzag around the trees (thesis 5.3).
        speed: m/s.
        stop_every: stop-and-go distance, m (0: never); `stop_s` the pause.
        laps: how often the run is driven.
        longest_s: the drive is cut there.
    """

    run: int = 1
    speed: float = 0.9
    stop_every: float = 0.0
    stop_s: float = 2.0
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
}
