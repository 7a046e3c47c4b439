"""Truncated and damaged recordings: what is whole is read, what is not is said."""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader

from topograph.bags import BagsConfig, Recording
from topograph.bags.salvage import Salvaged
from topograph.bags.writer import BagWriter
from topograph.errors import InputError

T0 = 1_700_000_000 * 10**9
FORMATS = ("none.bag", "lz4.bag", "bz2.bag", "none.mcap", "lz4.mcap", "zstd.mcap", "rows.db3")


def write(folder: Path, name: str) -> Path:
    """A recording of fixes (small) and clouds of text (large: overflow pages, several chunks), in one of the formats."""
    compression, suffix = name.split(".")
    out = folder / name
    source = folder / ("source.bag" if suffix == "bag" else "source")
    if not source.exists():
        rng = np.random.default_rng(1)
        with BagWriter(source) as w:
            for k in range(400):
                t = T0 + k * 50_000_000
                w.imu("/imu", t, t, "imu", rng.normal(0, 0.1, 3), np.array([0.0, 0.0, 9.81]))
                if k % 4 == 0:
                    w.fix("/fix", t, t, "gnss", np.array([45.0 + k * 1e-6, 11.0, 30.0]), 1e-4 * np.eye(3), 2)
                if k % 10 == 0:
                    cloud = np.zeros(3000, [("x", "f4"), ("y", "f4"), ("z", "f4")])
                    for n in "xyz":
                        cloud[n] = rng.normal(0, 1, 3000)
                    w.points("/points", t, t, "velodyne", cloud)
    with AnyReader([source]) as r:
        if suffix == "bag":
            writer = rosbag1.Writer(out)
            writer.chunk_threshold = 1 << 16
            if compression != "none":
                writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
            with writer:
                to = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=r.typestore) for c in r.connections}
                for c, t, raw in r.messages():
                    writer.write(to[c.id], t, raw)
            return out
        if suffix == "mcap":
            kind = CompressionType[compression.upper()]
            with out.open("wb") as f:
                mcap = McapWriter(f, chunk_size=1 << 16, compression=kind)
                mcap.start("ros2")
                ids = {}
                for c in r.connections:
                    text, _ = r.typestore.generate_msgdef(c.msgtype, ros_version=2)
                    schema = mcap.register_schema(c.msgtype, "ros2msg", text.encode())
                    ids[c.id] = mcap.register_channel(c.topic, "cdr", schema)
                for c, t, raw in r.messages():
                    mcap.add_message(ids[c.id], t, bytes(raw), t)
                mcap.finish()
            return out
        writer2 = rosbag2.Writer(folder / compression, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
        with writer2:
            to2 = {c.id: writer2.add_connection(c.topic, c.msgtype, typestore=r.typestore) for c in r.connections}
            for c, t, raw in r.messages():
                writer2.write(to2[c.id], t, raw)
    (folder / compression / f"{compression}.{suffix}").rename(out)
    return out


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("salvage")
    return {name: write(folder, name) for name in FORMATS}


def whole(path: Path) -> list[tuple[int, int]]:
    """(end, messages) of each block, by somebody else's reading of the file's index."""
    if path.suffix == ".bag":
        with rosbag1.Reader(path) as r:
            per = Counter(e.chunk_pos for index in r.indexes.values() for e in index)
            return [(r.chunks[p].datapos + r.chunks[p].datasize, n) for p, n in per.items()]
    if path.suffix == ".mcap":
        with path.open("rb") as f:
            summary = make_reader(f).get_summary()
            assert summary is not None
            out = []
            for c in summary.chunk_indexes:
                f.seek(0)
                ends = c.chunk_start_offset + c.chunk_length
                # 10 bytes of index for a channel and 16 for each of its messages (mcap.dev/spec, Message Index).
                heads = len(c.message_index_offsets) * (9 + 2 + 4)
                out.append((ends, (c.message_index_length - heads) // 16))
            return out
    with sqlite3.connect(path) as db:
        filled = np.cumsum([n for (n,) in db.execute("SELECT length(data) + 20 FROM messages ORDER BY id")])
        # SQLite has the page that begins a row behind those that it overflows to: the longest row and two pages of room.
        room = int(np.diff(filled).max()) + 2 * 4096
        return [(int(path.stat().st_size * f / filled[-1]) + room, 1) for f in filled]


def read(path: Path, **words: bool) -> tuple[Recording, Counter[str]]:
    with Recording([path], BagsConfig(**words)) as r:  # type: ignore[arg-type]  # only switches are given
        return r, Counter(k for k, _ in r.messages())


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("share", [0.999, 0.9, 0.6, 0.3])
def test_truncated(recordings: dict[str, Path], name: str, share: float, tmp_path: Path) -> None:
    source = recordings[name]
    cut = tmp_path / name
    data = source.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    wanted = sum(n for end, n in whole(source) if end <= share * len(data))
    assert wanted > 0.85 * (share - 0.05) * 540
    r, used = read(cut)
    assert used.total() >= 0.95 * wanted
    assert used.total() + sum(r.skipped.values()) == sum(r.counts[t] for t in r.chosen.values())
    assert any(name in note and "sequence" in note for note in r.notes)
    with pytest.raises(InputError, match=r"--strict"):
        read(cut, strict=True)


@pytest.mark.parametrize("name", FORMATS)
def test_without_its_index_a_recording_is_the_same(recordings: dict[str, Path], name: str) -> None:
    saved = Salvaged(recordings[name])
    assert saved.lost == ""
    with AnyReader([recordings[name]]) as r:
        theirs = [(c.topic, c.msgtype, t, bytes(raw)) for c, t, raw in r.messages()]
        ours = [(c.topic, c.msgtype, t, raw) for c, t, raw in saved.messages(saved.connections)]
        assert sorted(ours) == sorted(theirs)
        assert [m[2] for m in ours] == sorted(m[2] for m in theirs)
        c, _, raw = next(m for m in saved.messages(saved.connections) if m[0].topic == "/imu")
        again = saved.deserialize(raw, c.msgtype)
        assert again.linear_acceleration.z == 9.81  # type: ignore[attr-defined]  # a message's class is made at run time
    assert saved.start_time == theirs[0][2]
    half = (saved.start_time + saved.end_time) // 2
    parts = [list(saved.messages(saved.connections, a, b)) for a, b in ((None, half), (half, None))]
    assert [len(p) for p in parts] == [sum(t < half for *_, t, _ in ours), sum(t >= half for *_, t, _ in ours)]
    saved.close()


@pytest.mark.parametrize("name", FORMATS)
def test_a_hole_costs_no_more_than_its_blocks(recordings: dict[str, Path], name: str, tmp_path: Path) -> None:
    """4 KB of zeros in the middle: what follows is found again; what the index announced and is gone is counted."""
    source = recordings[name]
    data = bytearray(source.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4096] = bytes(4096)
    (tmp_path / name).write_bytes(data)
    r, used = read(tmp_path / name)
    hit = sum(n for end, n in whole(source) if middle - 200_000 < end < middle + 200_000)
    assert used.total() >= 540 - max(hit, 60)
    assert used.total() + sum(r.skipped.values()) == sum(r.counts[t] for t in r.chosen.values())


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(FORMATS), st.integers(0, 2**32), st.integers(1, 40))
def test_any_damage(recordings: dict[str, Path], tmp_path: Path, name: str, seed: int, flips: int) -> None:
    """Refused in one line, or read with an account that adds up; never a traceback."""
    rng = np.random.default_rng(seed)
    data = np.frombuffer(recordings[name].read_bytes(), np.uint8).copy()
    data[rng.integers(0, len(data), flips)] = rng.integers(0, 256, flips)
    path = tmp_path / name
    path.write_bytes(data[: rng.integers(len(data) // 4, len(data) + 1)].tobytes())
    try:
        r, used = read(path)
    except InputError:
        return
    lost = sum(n for reason, n in r.skipped.items() if not reason.startswith("tf"))
    assert used.total() + lost >= sum(r.counts[t] for t in r.chosen.values())


def test_folders_without_metadata_and_bags_in_progress(recordings: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(recordings["none.mcap"], folder / "run_0.mcap")
    _, all_of_it = read(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: [")
    r, used = read(folder)
    assert used == all_of_it
    assert any("metadata.yaml does not fit" in n for n in r.notes)
    half = recordings["none.bag"].read_bytes()
    active = tmp_path / "run.bag.active"
    active.write_bytes(half[: len(half) // 2])
    r, used = read(active)
    assert used.total() > 200
    assert any("never closed" in n for n in r.notes)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="without a recording"):
        read(tmp_path / "empty")


def test_a_rosbag_whose_last_chunk_was_never_closed(recordings: dict[str, Path], tmp_path: Path) -> None:
    """A recorder writes a chunk's length when it closes the chunk; killed before, the length reads zero."""
    source = recordings["none.bag"]
    with rosbag1.Reader(source) as r:
        last = max(r.chunks.values(), key=lambda c: c.datapos)
        n = sum(len(i) for i in r.indexes.values())
    data = bytearray(source.read_bytes()[: last.datapos + last.datasize])
    data[last.datapos - 4 : last.datapos] = bytes(4)
    (tmp_path / "killed.bag").write_bytes(data)
    _, used = read(tmp_path / "killed.bag")
    assert used.total() == n
