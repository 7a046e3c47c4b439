"""What a recording is good for, before anything is computed: each stream with its rate, gaps, clock, place and verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from topograph.bags import Recording, Scan, StreamSurvey, Survey, Trunks, survey
from topograph.config import Config
from topograph.errors import FrameError, InputError
from topograph.geometry import Array
from topograph.motion import align_imu
from topograph.pipeline.read import refuse_damaged
from topograph.session import Streams, StreamsBuilder

GAP = {"points": 1.0, "trunks": 2.0, "odometry": 0.5, "imu": 0.2, "fix": 10.0, "heading": 30.0}
"""Silences that are worth a word, s: trunks of the map, wheels and gyro are bridged for less."""
SILENT_STEPS = 5.0
"""Of a stream's own steps, and it is silent: sweeps may be taken at stops only."""
FASTEST_HZ = 40.0
"""Of a LiDAR's sweeps: beyond, a message holds a part of one."""
LATE = 0.5
"""Stamps whose distance from the time of recording differs by more between streams, s."""
LOW = {"odometry": 5.0, "imu": 20.0}
"""Rates below which a stream is of little use, Hz."""
LIDAR, BASE = (0.1, 4.5), (-0.5, 2.0)
"""Heights of a LiDAR and of a robot's base above the ground, m, between which they are to be believed."""
STATUS = {-2: "not told", -1: "no fix", 0: "single or float", 1: "SBAS", 2: "RTK or DGNSS"}


@dataclass(slots=True, kw_only=True)
class Role:
    """A stream and what is to be said of it.

    Attributes:
        stream: None where the recording has none of this kind.
        facts, problems: sentences; a stream with problems is still used.
        missing: what its absence means; "" where it is there.
    """

    kind: str
    stream: StreamSurvey | None
    facts: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    missing: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """Of a whole recording.

    Attributes:
        blockers: why `map` cannot run, and what to type; empty: it can.
    """

    duration_s: float
    messages: int
    roles: list[Role]
    frames: list[str]
    others: list[tuple[str, str, int]]
    notes: list[str]
    blockers: list[str]
    skipped: Counter[str]


def inspect_bags(paths: Sequence[Path], config: Config) -> Inspection:
    """Read a recording once and say what `map` and its audit will find in it.

    Raises:
        InputError: it cannot be read, or several topics could be one stream.
    """
    with Recording(paths, config.bags) as recording:
        found = survey(recording)
        builder = StreamsBuilder()
        for p in found.products:
            if not isinstance(p, Trunks):
                builder.add(p)
        streams = builder.build(recording.skipped)
        roles = {k: Role(kind=k, stream=found.streams.get(k)) for k in GAP}
        for role in roles.values():
            _common(role, recording, found)
        blockers = _points(roles["points"], roles["trunks"], recording, found)
        _imu(roles["imu"], streams, recording)
        blockers += _fixes(roles["fix"], roles["odometry"], streams)
        try:
            refuse_damaged(recording)
        except InputError as err:
            blockers.append(str(err))
        used = set(recording.chosen.values())
        return Inspection(
            duration_s=recording.duration_s,
            messages=sum(recording.counts.values()),
            roles=list(roles.values()),
            frames=recording.frames.names(),
            others=[(t, recording.types[t], n) for t, n in sorted(recording.counts.items()) if t not in used],
            notes=list(found.notes),
            blockers=blockers,
            skipped=recording.skipped,
        )


MISSING = {
    "points": "no point cloud",
    "trunks": "",
    "odometry": "no wheel odometry: the path between fixes rests on IMU and trunks",
    "imu": "no IMU: attitude rests on the trunks, turns on the wheels",
    "fix": "no GNSS: the map will not be georeferenced",
    "heading": "no heading: it is found from course and fixes",
}


def _common(role: Role, recording: Recording, found: Survey) -> None:
    """Rate, gaps, clock and place of a stream."""
    s = role.stream
    if s is None:
        options = " or ".join(f"--topic-{role.kind} {t}" for t in recording.to_name(role.kind))
        role.missing = MISSING[role.kind] + (f"; if it is measured, in the robot's frame: {options}" if options else "")
        return
    gap, at = s.longest_gap(recording.duration_s)
    if gap > max(GAP[role.kind], SILENT_STEPS / max(s.rate_hz, 1e-3)):
        role.problems.append(f"silent for {gap:.1f} s from {at:.1f} s on")
    if 0 < s.rate_hz < LOW.get(role.kind, 0.0):
        role.problems.append(f"{s.rate_hz:.1f} Hz is too slow to be of much use")
    usual = [float(np.median(o.offset_s)) for o in found.streams.values() if len(o.offset_s)]
    if len(s.offset_s):
        own, middle = float(np.median(s.offset_s)), min(usual, key=abs)
        if abs(own - middle) > LATE:
            role.problems.append(
                f"stamps are {own - middle:+.2f} s from the other streams': a clock of its own, or recorded late"
            )
        spread = float(np.ptp(np.percentile(s.offset_s, [5, 95])))
        if spread > LATE:
            role.problems.append(f"stamps wander by {spread:.1f} s against the time of recording")
    if role.kind in ("imu", "fix", "heading") and recording.frames.of(role.kind, s.frame) is None:
        word = s.frame or role.kind
        role.problems.append(
            f"frame {s.frame!r} is not in TF: add --extrinsic {word}=X,Y,Z,ROLL,PITCH,YAW (metres, radians)"
        )
    elif s.frame and role.kind != "odometry":
        place = recording.frames.of(role.kind, s.frame)
        if place is not None:
            role.facts.append(f"{s.frame} in {recording.frames.base}: {mounting(place)}")


def mounting(base_T_sensor: Array) -> str:
    """Position and angles in words."""
    roll, pitch, yaw = Rotation.from_matrix(base_T_sensor[:3, :3]).as_euler("xyz", degrees=True)
    x, y, z = base_T_sensor[:3, 3]
    return f"{x:.2f} {y:.2f} {z:.2f} m, roll {roll:.0f}° pitch {pitch:.0f}° yaw {yaw:.0f}°"


def _points(points: Role, trunks: Role, recording: Recording, found: Survey) -> list[str]:
    """Facts of the clouds; what keeps trunks from being found."""
    if points.stream is None and trunks.stream is None:
        packets = [f"{t} holds a LiDAR's raw packets: make clouds of them with {what}" for t, what in found.raw.items()]
        return packets or [
            "neither point clouds nor recorded trunks: name a topic with --topic-points or --topic-trunks"
        ]
    if points.stream is None:
        points.missing = "recorded trunks are used in place of clouds"
        assert trunks.stream is not None
        return _no_mount(trunks.stream, recording)
    trunks.missing = "clouds are used; --topic-trunks would take recorded ones"
    clouds = [c for c in found.clouds if np.isfinite(c.xyz).all(axis=1).any()]
    if len(clouds) < len(found.clouds):
        points.problems.append(
            f"{len(found.clouds) - len(clouds)} of {len(found.clouds)} clouds that were looked at are empty"
        )
    if not clouds:
        return [
            f"{points.stream.topic}: no cloud of it can be decoded ({recording.undecoded.get('points', 'damaged')})"
        ]
    points.facts.append(f"{np.median([len(c.xyz) for c in clouds]):.0f} points of {' '.join(found.fields)}")
    points.facts.append(_times(clouds))
    if points.stream.rate_hz > FASTEST_HZ:
        points.problems.append(
            f"{points.stream.rate_hz:.0f} clouds a second are parts of sweeps: join those of a turn into one"
        )
    if clouds[0].offset is None:
        points.problems.append("no time per point: sweeps cannot be deskewed")
    blockers = _no_mount(points.stream, recording)
    if blockers:
        return blockers
    place = recording.frames.get(points.stream.frame)
    from topograph.trunks.detector import heights_above_ground
    from topograph.trunks.organise import rings_of
    from topograph.trunks.origin import lidar_of, moved_back

    lidar = lidar_of(clouds[0], place, recording.frames.all())
    if lidar is not None:
        points.facts.append(
            f"moved into {points.stream.frame} before: the points lie in rings about {lidar[0]}, and are taken as seen from there"
        )
        place = place @ lidar[1]
        clouds = [moved_back(c, lidar[1]) for c in clouds]

    ring, tangent = rings_of(clouds[0])
    order = "no ring field: rings are told by elevation"
    if clouds[0].ring is not None:
        told = clouds[0].ring
        same = np.corrcoef(told, ring)[0, 1] if np.ptp(told) and np.ptp(ring) else 1.0
        order = f"ring field counts from {'below' if same > 0.99 else 'above' if same < -0.99 else 'neither end'}"
    if not len(tangent):
        return ["the clouds hold no returns"]
    low, high = np.degrees(np.arctan([tangent.min(), tangent.max()]))
    points.facts.append(f"{len(tangent)} rings, {low:.0f}° to {high:.0f}°; {order}")
    heights = np.array([heights_above_ground(c, place) for c in clouds])
    heights = heights[np.isfinite(heights[:, 0])]
    if len(heights):
        lidar, base = np.median(heights, axis=0)
        points.facts.append(f"above the ground: LiDAR {lidar:.2f} m, {recording.frames.base} {base:.2f} m")
        if not LIDAR[0] < lidar < LIDAR[1] or not BASE[0] < base < BASE[1]:
            points.problems.append("these heights above the ground are not to be believed: check its mounting")
    else:
        points.problems.append("no ground is seen below the LiDAR: check its mounting")
    return []


def _no_mount(stream: StreamSurvey, recording: Recording) -> list[str]:
    """What keeps trunks from being placed: no way from the base to their sensor."""
    try:
        recording.frames.get(stream.frame)
    except FrameError as err:
        return [str(err)]
    return []


def _times(clouds: Sequence[Scan]) -> str:
    timed = [c.offset for c in clouds if c.offset is not None]
    if not timed:
        return "no usable time per point"
    first, last = (float(np.median([f(o) for o in timed])) for f in (np.nanmin, np.nanmax))
    return f"points are taken {first:+.3f} to {last:+.3f} s around the stamp"


def _imu(role: Role, streams: Streams, recording: Recording) -> None:
    """Gravity, as the mounting lets it be seen."""
    if role.stream is None or not len(streams.imu_ns):
        return
    size = float(np.median(np.linalg.norm(streams.accel, axis=1)))
    role.facts.append(f"specific force {size:.2f} m/s²")
    mount = recording.frames.of("imu", role.stream.frame)
    inertial, _, notes = align_imu(streams, mount)
    role.problems += [n for n in notes if "IMU frame" not in n]
    if inertial is not None and mount is not None:
        up = np.median(inertial.accel, axis=0)
        role.facts.append(f"gravity {np.degrees(np.arccos(up[2] / np.linalg.norm(up))):.1f}° off the base's vertical")


def _fixes(fix: Role, odometry: Role, streams: Streams) -> list[str]:
    """Table of GNSS status; what keeps the path from being found."""
    if fix.stream is not None:
        sigma = streams.fix_sigma()
        for status in sorted(set(streams.fix_status.tolist()), reverse=True):
            mine = streams.fix_status == status
            fix.facts.append(
                f"status {status} ({STATUS.get(status, 'unknown')}): {mine.sum()} fixes, stated ± {np.median(sigma[mine]):.3f} m"
            )
        if len(streams.fix_ns):
            reach = float(np.linalg.norm(np.ptp(streams.fixes_enu()[:, :2], axis=0)))
            fix.facts.append(f"over {reach:.0f} m")
        else:
            fix.problems.append("no fix of it can be used")
    if odometry.stream is not None and len(streams.odometry_ns):
        speed = np.abs(streams.twist[:, 0])
        turn = np.abs(streams.twist[:, 5])
        odometry.facts.append(
            f"up to {np.percentile(speed, 99):.1f} m/s and {np.degrees(np.percentile(turn, 99)):.0f}°/s, standing {100 * np.mean(speed < 0.02):.0f} % of it"
        )
        odometry.facts.append(f"of {odometry.stream.frame or 'a frame without a name'}")
        return []
    if len(streams.fix_ns) >= 10:
        return []
    return [
        "neither wheel odometry nor ten usable fixes: the distance between scans is unknown; name topics with --topic-odometry or --topic-fix"
    ]
