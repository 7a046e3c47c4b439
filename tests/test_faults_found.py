"""What a fresh reader broke: each of these once came out wrong without a word, or crashed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults import base
from faults import write as write_bag
from test_cli import call

from topograph.config import Config
from topograph.errors import InputError
from topograph.evaluate import map_metrics
from topograph.geometry import from_quaternion, inverse, to_quaternion
from topograph.mapping import Mapper
from topograph.pipeline import audited, read_run, solve_run, topo_map
from topograph.pipeline.mapping import mapping_config
from topograph.trunks import TrunksConfig, from_recorded


def wheels_times(factor: float, begin: float, end: float):
    """Wheels that tell `factor` times the way between two times, s."""

    def change(bag) -> None:
        pose: np.ndarray | None = None
        last: np.ndarray | None = None
        for e in sorted(bag.of("odometry"), key=lambda e: e.it.stamp_ns):
            q = e.it.odom_T_child
            now = from_quaternion(q[:3], q[3:])
            if last is None or pose is None:
                pose = now
            else:
                step = inverse(last) @ now
                if begin <= bag.at(e) < end:
                    step[:3, 3] *= factor
                pose = pose @ step
            last = now
            e.it = replace(e.it, odom_T_child=np.concatenate([pose[:3, 3], np.ravel(to_quaternion(pose[None]))]))

    return change


@pytest.mark.parametrize("factor", [0.0, 3.0])
def test_wheels_that_slip_without_gnss_are_bridged_by_trunks(tmp_path: Path, factor: float) -> None:
    """21 of 36 trees were ghosts."""
    bag = base(77, tmp_path)
    bag.events = [e for e in bag.events if e.kind not in ("fix", "heading")]
    wheels_times(factor, 20.0, 23.0)(bag)
    write_bag(bag, tmp_path / "slip.bag")
    run = read_run([tmp_path / "slip.bag"], Config())
    solved = solve_run(run, Config())
    got = {m.name: m.value for m in map_metrics(topo_map(solved, Config(), {}), bag.truth)}
    assert got["tree precision"] == 1.0
    assert got["tree error max"] < 0.1
    assert any("slipped" in n and "trunks' speed" in n for n in run.notes)


def test_sound_wheels_are_not_bridged(tmp_path: Path) -> None:
    bag = base(77, tmp_path)
    bag.events = [e for e in bag.events if e.kind not in ("fix", "heading")]
    write_bag(bag, tmp_path / "sound.bag")
    run = read_run([tmp_path / "sound.bag"], Config())
    assert not solve_run(run, Config()).motion.slips_by_trunks


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_a_lidar_mounted_otherwise_is_refused(lidar_run, yaw: float) -> None:
    """Seven trees, none of them real, were called sound."""
    c = Config()
    mount = (0.22, 0.0, 0.84, 0.0, 0.0, yaw)
    c = replace(c, bags=replace(c.bags, extrinsics={"velodyne": mount} if yaw else {}))
    verdict = audited(solve_run(read_run([lidar_run[0]], c), c))
    assert (verdict.word == "refused") == bool(yaw)


def test_the_mapper_takes_what_a_broken_driver_sends(tmp_path: Path) -> None:
    bag = base(77, tmp_path)
    find = bag.mounts.get
    mapper = Mapper(mapping_config(Config()), lambda f: find(f, np.eye(4)), lambda _, f: find(f))
    bad = {
        "odometry": lambda m: replace(m, odom_T_child=m.odom_T_child * np.nan),
        "imu": lambda m: replace(m, gyro=m.gyro * np.nan),
        "trunks": lambda m: replace(m, stamp_ns=m.stamp_ns + 365 * 86_400 * 10**9),
    }
    for n, e in enumerate(sorted(bag.events, key=lambda e: e.log_ns)):
        it = bad[e.kind](e.it) if n % 50 == 7 and e.kind in bad else e.it
        if e.kind == "trunks":
            it = from_recorded(it, np.eye(4), TrunksConfig())
            axis = it.axis * (np.nan if n % 30 == 1 else 1.0)
            mapper.process(replace(it, axis=axis))
        else:
            mapper.hear([it])
    solved = mapper.solve()
    assert solved is not None
    got = {m.name: m.value for m in map_metrics(topo_map(solved, Config(), {}), bag.truth)}
    assert got["tree precision"] == got["tree recall"] == 1.0
    skipped = mapper.session().skipped
    assert any(k.startswith("odometry: not finite") for k in skipped)
    assert any("stamped far" in k for k in skipped)


def test_numbers_that_are_none_are_bounded_like_damage(tmp_path: Path) -> None:
    """Half of the detections NaN came out sound; a window that holds nothing but damage was compared with the whole recording."""
    for name, first, last in (("half", 0.0, 30.0), ("window", 20.0, 26.0)):
        bag = base(77, tmp_path)
        for e in bag.of("trunks"):
            if first <= bag.at(e) < last:
                e.it = replace(e.it, p=e.it.p * np.nan)
        write_bag(bag, tmp_path / f"{name}.bag")
    with pytest.raises(InputError, match="not finite"):
        read_run([tmp_path / "half.bag"], Config())
    run = read_run([tmp_path / "window.bag"], Config())
    assert run.skipped["trunks: not finite"] in (59, 60, 61)
    assert run.announced["trunks"] == run.skipped["trunks: not finite"] + run.scans
    with pytest.raises(InputError, match="not finite"):
        read_run([tmp_path / "window.bag"], Config(), span_s=(21.0, 25.0))


def test_nothing_is_written_over_an_input(tmp_path: Path) -> None:
    bag = base(77, tmp_path)
    path = tmp_path / "v.bag"
    write_bag(bag, path)
    before = path.read_bytes()
    assert call("detect", path, "--csv", path).exit_code == 2
    assert path.read_bytes() == before
    assert call("map", path, "-o", tmp_path / "m.gpkg", "--results", tmp_path / "r", "-q").exit_code == 0
    assert call("view", tmp_path / "m.gpkg", tmp_path / "m.gpkg").exit_code == 2
    assert call("map", path, "-c", "/dev/zero").exit_code == 2
