"""A run as it is driven: poses on the way, the map at the end, GNSS that comes late, a map that was there before."""

import subprocess
import sys
from dataclasses import fields, replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from topograph.bags import Fix, Heading, Imu, Recording, Trunks
from topograph.cli import main
from topograph.config import Config
from topograph.errors import InputError, UsageError
from topograph.evaluate import Truth
from topograph.evaluate.metrics import match, tree_errors
from topograph.geometry import inverse
from topograph.mapping import Mapper
from topograph.motion import Reckoner
from topograph.pipeline import JOURNAL, extend, live_metrics, play, read_run, solve_run, topo_map
from topograph.pipeline.living import Live, State, _Renewed, _Solving
from topograph.pipeline.mapping import mapping_config
from topograph.pipeline.read import stream
from topograph.session import Journal, Journaled
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.topomap import TopoMap

SEED = 66


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("live")
    record(out / "run1.bag", SEED, "olive", DriveConfig(longest_s=45.0), SensorConfig(detections=True))
    record(
        out / "run2.bag", SEED, "olive", DriveConfig(run=2, longest_s=45.0), SensorConfig(detections=True, gnss="none")
    )
    return out


@pytest.fixture(scope="module")
def batch(folder: Path) -> TopoMap:
    return topo_map(solve_run(read_run([folder / "run1.bag"], Config()), Config()), Config(), {})


def test_poses_on_the_way_are_right_and_the_map_is_that_of_the_recording(folder: Path, batch: TopoMap) -> None:
    played = play([folder / "run1.bag"], Config())
    assert played.solved is not None
    m = {x.name: x.value for x in live_metrics(played, Truth.load(folder / "run1.truth"))}
    assert m["live: scans with a pose"] > 0.85
    assert m["live: position error mean"] < 0.05
    assert m["live: position error 99 %"] < 0.2
    topo = topo_map(played.solved, Config(), {})
    assert len(topo) == len(batch)
    assert np.linalg.norm(topo.p - batch.p, axis=1).max() < 1e-6
    assert played.states[0].state == "starting"
    assert played.states[-1].state == "mapping"


def test_solves_beside_the_driving_hold_no_scan_up(folder: Path) -> None:
    """At ten times its pace, solves come late and rarely; poses are still there, and right, and no scan takes as long as a solve."""
    played = play([folder / "run1.bag"], Config(), speed=10.0)
    m = {x.name: x.value for x in live_metrics(played, Truth.load(folder / "run1.truth"))}
    assert m["live: scans with a pose"] > 0.3
    assert m["live: position error mean"] < 0.3
    longest_solve = max(s.solve_s for s in played.states)
    assert longest_solve > 0
    assert np.percentile([s.seconds for s in played.states], 90) < longest_solve


def test_a_solve_that_runs_at_the_end_is_not_waited_for(folder: Path, batch: TopoMap) -> None:
    """Its map is larger than a pipe holds: joining it before reading waited for ever."""
    many = replace(batch, meta={"config": "x" * 300_000})
    solving = _Solving.__new__(_Solving)
    solving._result, mine = get_context("fork").Pipe(duplex=False)
    solving._process = get_context("fork").Process(
        target=mine.send, args=(_Renewed(many, 1, np.eye(4), 0.1),), daemon=True
    )
    solving._process.start()
    mine.close()
    found = solving.result()
    assert found is not None
    assert len(found.topo.meta["config"]) == 300_000


def test_coordinates_keep_their_origin_while_fixes_come_slowly(folder: Path) -> None:
    """The first 25 fixes make the origin: at one a second it would move for half a minute under whoever drives by it."""
    config = Config()
    states: list[State] = []
    with Recording([folder / "run1.bag"], config.bags) as recording:
        mapper = Mapper(mapping_config(config), recording.frames.find, recording.frames.of, start_ns=recording.start_ns)
        live = Live(mapper, config, Reckoner(None, recording.frames.get("imu_link")[:3, :3]))
        heard: list[Any] = []
        n = 0
        for m in stream(recording, config):
            if isinstance(m, Trunks):
                states.append(live.process(m, heard))
                heard = []
                continue
            n += isinstance(m, Fix)
            if not isinstance(m, Fix) or n % 5 == 0:
                heard.append(m)
    assert len({s.datum for s in states if s.datum is not None}) == 1


def test_with_a_map_gnss_is_taken_in(folder: Path, batch: TopoMap) -> None:
    """A run with RTK lies as right in an older map as `map --into` lays it."""
    record(folder / "run3.bag", SEED, "olive", DriveConfig(run=2, longest_s=40.0), SensorConfig(detections=True))
    played = play([folder / "run3.bag"], Config(), batch)
    assert played.solved is not None
    assert not played.solved.problem.placed
    other = solve_run(read_run([folder / "run3.bag"], Config()), Config(), known=batch)
    np.testing.assert_allclose(played.solved.estimate.map_T_robot, other.estimate.map_T_robot, atol=1e-9)


def test_the_same_recording_does_not_extend_its_own_map(folder: Path, batch: TopoMap) -> None:
    with pytest.raises(UsageError, match="in the map already"):
        play([folder / "run1.bag"], Config(), batch)


def test_gnss_that_comes_late_moves_the_map_into_its_frame(folder: Path, batch: TopoMap) -> None:
    config = Config()
    states: list[State] = []
    with Recording([folder / "run1.bag"], config.bags) as recording:
        frames = recording.frames
        mapper = Mapper(mapping_config(config), frames.find, frames.of)
        live = Live(mapper, config, Reckoner(None, frames.get("imu_link")[:3, :3]))
        heard: list[Any] = []
        for m in stream(recording, config):
            if isinstance(m, Trunks):
                states.append(live.process(m, heard))
                heard = []
            elif not isinstance(m, (Fix, Heading)) or m.stamp_ns > recording.start_ns + 20 * 10**9:
                heard.append(m)
        solved = live.finish()
    before = [s for s in states if s.solved_ns and s.stamp_ns < recording.start_ns + 18 * 10**9]
    assert before
    assert not any(s.georeferenced for s in before)
    assert states[-1].georeferenced
    topo = topo_map(solved, config, {}, clouds=False)
    assert topo.datum is not None
    ours, _, error = tree_errors(topo, Truth.load(folder / "run1.truth"))
    assert len(ours) == len(topo)
    assert np.linalg.norm(error[:, :2], axis=1).mean() < 0.05
    assert len(topo) == len(batch)


def test_with_a_map_it_localizes_and_adds_what_is_new(folder: Path, batch: TopoMap) -> None:
    played = play([folder / "run2.bag"], Config(), batch)
    assert played.solved is not None
    both = extend(batch, topo_map(played.solved, Config(), {}), played.solved, Config())
    assert len(both) > len(batch)
    truth = Truth.load(folder / "run2.truth")
    ours, _, error = tree_errors(both, truth)
    assert len(ours) == len(both)
    assert np.linalg.norm(error[:, :2], axis=1).max() < 0.1
    told = [s for s in played.states if s.map_T_robot is not None]
    assert len(told) > 0.8 * len(played.states)
    # Where it was told to be on the way is where the whole run puts it.
    e = played.solved.estimate
    last = told[-1]
    assert last.map_T_robot is not None
    apart = (inverse(e.map_T_robot[-1]) @ last.map_T_robot)[:2, 3]
    assert np.linalg.norm(apart) < 0.6  # one keyframe


def test_a_run_that_was_killed_is_mapped_from_its_journal(folder: Path, batch: TopoMap) -> None:
    """SIGKILL in the middle: what was driven until half a second before is there, and its map is that of so much of the recording."""
    target = folder / "killed.gpkg"
    program = "from topograph.cli import main; main()"
    words = ["live", str(folder / "run1.bag"), "-o", str(target), "--speed", "4", "--every", "0"]
    child = subprocess.Popen([sys.executable, "-c", program, *words], stdout=subprocess.PIPE, text=True, cwd=folder)
    assert child.stdout is not None
    for _ in range(180):
        line = child.stdout.readline()
    child.kill()
    child.wait()
    child.stdout.close()
    journal = target.with_name(target.name + JOURNAL)
    assert journal.exists()
    assert not target.exists()
    before = journal.read_bytes()
    played = play([journal], Config())
    assert journal.read_bytes() == before
    assert played.solved is not None
    said = int(float(line.split()[0]) * 10)
    last = played.states[-1].stamp_ns // 10**8
    assert last >= said - 10 * 4 * 1  # a second of driving at four times its pace
    with Recording([folder / "run1.bag"], Config().bags) as recording:
        span = 0.1 * last - recording.start_ns * 1e-9 + 0.05
    part = solve_run(read_run([folder / "run1.bag"], Config(), span_s=(0.0, span)), Config())
    whole, again = topo_map(part, Config(), {}), topo_map(played.solved, Config(), {})
    i, j = match(again.p[:, :2], whole.p[:, :2])
    assert len(i) >= len(whole) - 1
    assert np.linalg.norm(again.p[i] - whole.p[j], axis=1).mean() < 0.01
    runner = CliRunner()
    refused = runner.invoke(main, ["live", str(folder / "run1.bag"), "-o", str(target)])
    assert refused.exit_code == 2
    assert ".journal" in refused.output


def test_a_journal_is_the_run_to_the_last_bit(folder: Path) -> None:
    config = Config()
    path = folder / "own.journal"
    with Recording([folder / "run1.bag"], config.bags) as recording:
        messages = list(islice(stream(recording, config), 3000))
        journal = Journal(
            path,
            start_ns=recording.start_ns,
            chosen=dict(recording.chosen),
            find=recording.frames.find,
            mount=recording.frames.of,
        )
        for m in messages:
            journal.see(m) if isinstance(m, Trunks) else journal.hear(m)
        journal.close()
        left = Journaled(path)
        again = list(left.messages())
        assert left.start_ns == recording.start_ns
        assert left.chosen == dict(recording.chosen)
        for frame in ("imu_link", "nowhere"):
            np.testing.assert_equal(left.find(frame), recording.frames.find(frame))
    assert len(again) == len(messages)
    for one, other in zip(messages, again, strict=True):
        assert type(one) is type(other)
        for name in (f.name for f in fields(one)):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), strict=False)
    (folder / "no.journal").write_bytes(b"not at all")
    with pytest.raises(InputError, match="no journal"):
        play([folder / "no.journal"], config)
    whole = path.read_bytes()
    scans = sum(isinstance(m, Trunks) for m in messages)
    for cut in (len(whole) - 7, len(whole) // 2):
        path.write_bytes(whole[:cut])
        torn = Journaled(path)
        assert sum(isinstance(m, Trunks) for m in torn.messages()) >= scans * cut // len(whole) - 2
    spoiled = bytearray(whole)
    spoiled[len(whole) // 2 : len(whole) // 2 + 40] = bytes(40)
    path.write_bytes(spoiled)
    torn = Journaled(path)
    assert sum(isinstance(m, Trunks) for m in torn.messages()) >= scans - 2
    assert torn.damaged >= 1


def test_what_comes_between_scans_does_not_wait(folder: Path) -> None:
    """A silent LiDAR: messages are on disk half a second later, though no scan comes; a disk that is full ends the journal, not the drive."""
    path = folder / "slow.journal"
    journal = Journal(path, start_ns=1, chosen={}, find=lambda _: None, mount=lambda _, __: None)
    m = Imu(5, "imu", np.ones(3), np.ones(3))
    journal.hear(m)
    journal._written -= 1.0
    journal.hear(m)
    assert len(list(Journaled(path).messages())) == 2  # it was not closed
    full = Path("/dev/full")
    if full.exists():
        journal._file.close()
        journal._file = full.open("wb", buffering=0)
        journal.hear(m)
        journal.flush()
        assert "ends early" in journal.broken
        journal.close()
