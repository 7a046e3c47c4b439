"""Truncated and damaged recordings: what is whole is read, what is not is said."""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fuzz import copy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1
from rosbags.highlevel import AnyReader

from topograph.bags import BagsConfig, Recording
from topograph.bags.salvage import Salvaged
from topograph.bags.writer import BagWriter
from topograph.errors import InputError

T0 = 1_700_000_000 * 10**9
FORMATS = ("none.bag", "lz4.bag", "bz2.bag", "none.mcap", "lz4.mcap", "zstd.mcap", "rows.db3")


def write(folder: Path, name: str) -> Path:
    """A recording of fixes (small) and clouds of text (large: overflow pages, several chunks), in one of the formats."""
    source = folder / ("source.bag" if name.endswith(".bag") else "source")
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
    return copy(source, folder, name)


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


def test_names_and_kinds(recordings: dict[str, Path], tmp_path: Path) -> None:
    """Another format's suffix inside a name, and characters that mean something in an address."""
    data = recordings["zstd.mcap"].read_bytes()
    (tmp_path / "field.bag.mcap").write_bytes(data[: len(data) // 2])
    assert read(tmp_path / "field.bag.mcap")[1].total() > 200
    whole_db = recordings["rows.db3"].read_bytes()
    (tmp_path / "run1.db3").write_bytes(whole_db)
    (tmp_path / "run%31.db3").write_bytes(whole_db[: len(whole_db) // 2])
    assert read(tmp_path / "run1.db3")[1].total() == 540
    assert 200 < read(tmp_path / "run%31.db3")[1].total() < 300
    (tmp_path / "a b%41#?.db3").write_bytes(whole_db)
    r, used = read(tmp_path / "a b%41#?.db3", strict=True)
    assert used.total() == 540
    assert not r.notes


def test_the_last_part_of_a_run_may_be_empty(recordings: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(recordings["none.mcap"], folder / "run_0.mcap")
    (folder / "run_1.mcap").write_bytes(b"")
    (folder / "metadata.yaml").write_text("nothing: here")
    r, used = read(folder)
    assert used.total() == 540
    assert any("left out" in n and "run_1.mcap" in n for n in r.notes)
    with pytest.raises(InputError, match="given twice"):
        read_all([folder, folder / "run_0.mcap"])


def read_all(paths: list[Path]) -> None:
    with Recording(paths) as r:
        list(r.messages())


def test_messages_in_a_journal_are_read(recordings: dict[str, Path], tmp_path: Path) -> None:
    """rosbag2's resilient profile: killed, half of the messages are in the write-ahead log."""
    path = tmp_path / "run.db3"
    shutil.copy(recordings["rows.db3"], path)
    with sqlite3.connect(path) as db:
        rows = db.execute("SELECT topic_id, timestamp, data FROM messages WHERE id > 300").fetchall()
        db.execute("DELETE FROM messages WHERE id > 300")
    db.close()
    db = sqlite3.connect(path)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA wal_autocheckpoint=0")
    with db:
        db.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    killed = tmp_path / "killed"
    killed.mkdir()
    for p in (path, path.with_name("run.db3-wal")):
        shutil.copy(p, killed)
    db.close()
    before = (killed / "run.db3").read_bytes()
    r, used = read(killed / "run.db3")
    assert used.total() == 540
    assert any("was not closed" in n for n in r.notes)
    assert (killed / "run.db3").read_bytes() == before  # read-only
    with pytest.raises(InputError, match="--strict"):
        read(killed / "run.db3", strict=True)


def test_sqlite_says_how_many_are_lost_and_survives_its_page_size(recordings: dict[str, Path], tmp_path: Path) -> None:
    data = bytearray(recordings["rows.db3"].read_bytes())
    data[16:18] = (8192).to_bytes(2, "big")
    data[40 * 4096 : 60 * 4096] = bytes(20 * 4096)
    (tmp_path / "x.db3").write_bytes(data)
    r, used = read(tmp_path / "x.db3")
    lost = 540 - used.total()
    assert 0 < lost < 60
    assert any(f"{lost} messages that the numbers of the others tell of" in n for n in r.notes), r.notes


def test_a_flipped_time_costs_its_message(tmp_path: Path, recordings: dict[str, Path]) -> None:
    """Of a message outside of chunks: the recording does not become one of centuries, and a broken length costs little."""
    path = tmp_path / "bare.mcap"
    with AnyReader([recordings["none.mcap"]]) as r, path.open("wb") as f:
        w = McapWriter(f, use_chunking=False)
        w.start("ros2")
        ids = {}
        for c in r.connections:
            text, _ = r.typestore.generate_msgdef(c.msgtype, ros_version=2)
            ids[c.id] = w.register_channel(c.topic, "cdr", w.register_schema(c.msgtype, "ros2msg", text.encode()))
        for c, t, raw in r.messages():
            w.add_message(ids[c.id], t, bytes(raw), t)
        w.finish()
    data = path.read_bytes()
    found = [
        k
        for k in range(len(data) - 40)
        if data[k] == 5 and int.from_bytes(data[k + 15 : k + 23], "little") // 10**9 == T0 // 10**9
    ]
    assert len(found) > 20
    for bit in (62, 63, 52):
        broken = bytearray(data[: int(0.95 * len(data))])
        broken[found[5] + 15 + bit // 8] ^= 1 << bit % 8
        (tmp_path / "b.mcap").write_bytes(broken)
        r2, used = read(tmp_path / "b.mcap")
        assert r2.duration_s < 25
        assert used.total() > 480
    broken = bytearray(data[: int(0.95 * len(data))])
    broken[found[5] + 2] ^= 0x40  # its length
    (tmp_path / "b.mcap").write_bytes(broken)
    assert read(tmp_path / "b.mcap")[1].total() > 480


def test_ros1_messages_in_mcap(recordings: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "ros1.mcap"
    with AnyReader([recordings["none.bag"]]) as r, path.open("wb") as f:
        w = McapWriter(f)
        w.start("ros1")
        ids = {}
        for c in r.connections:
            text, _ = r.typestore.generate_msgdef(c.msgtype, ros_version=1)
            name = c.msgtype.replace("/msg/", "/")
            ids[c.id] = w.register_channel(c.topic, "ros1", w.register_schema(name, "ros1msg", text.encode()))
        for c, t, raw in r.messages():
            w.add_message(ids[c.id], t, bytes(raw), t)
        w.finish()
    r2, used = read(path)
    assert used.total() == 540
    assert not r2.skipped


def test_small_files_do_not_become_large(tmp_path: Path) -> None:
    """A chunk of a few hundred bytes that unpacks to gigabytes, a chain of pages that bites its tail, and junk between records."""
    import bz2
    import tracemalloc

    def field(name: bytes, value: bytes) -> bytes:
        return (len(name) + 1 + len(value)).to_bytes(4, "little") + name + b"=" + value

    def record(fields: bytes, data: bytes) -> bytes:
        return len(fields).to_bytes(4, "little") + fields + len(data).to_bytes(4, "little") + data

    packed = bz2.compress(bytes(10**9))
    chunk = record(
        field(b"compression", b"bz2") + field(b"op", b"\x05") + field(b"size", (100).to_bytes(4, "little")), packed
    )
    (tmp_path / "bomb.bag").write_bytes(b"#ROSBAG V2.0\n" + chunk * 3)
    head = bytearray(4096)
    head[:16], head[16:18] = b"SQLite format 3\0", (4096).to_bytes(2, "big")
    leaf = bytearray(4096)
    leaf[0], leaf[3:5], leaf[5:7], leaf[8:10] = (
        0x0D,
        (1).to_bytes(2, "big"),
        (100).to_bytes(2, "big"),
        (100).to_bytes(2, "big"),
    )
    leaf[100:106] = bytes([0x81, 0x80, 0x80, 0x80, 0x00, 0x01])  # 2^28 bytes
    leaf[4092:4096] = (3).to_bytes(4, "big")
    loop = (3).to_bytes(4, "big") + bytes(4092)
    (tmp_path / "loop.db3").write_bytes(bytes(head + leaf) + loop)
    message = record(field(b"conn", bytes(4)) + field(b"op", b"\x02") + field(b"time", bytes(8)), b"x")
    (tmp_path / "junk.bag").write_bytes(b"#ROSBAG V2.0\n" + (message + b"\x01") * 30_000)
    tracemalloc.start()
    for name in ("bomb.bag", "loop.db3", "junk.bag"):
        with pytest.raises(InputError, match="no message"):
            Salvaged(tmp_path / name)
    assert tracemalloc.get_traced_memory()[1] < 1e8
    tracemalloc.stop()
