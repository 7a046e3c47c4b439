"""Broken files: is every one read rightly or refused in one line?  python tools/fuzz.py bags|maps|kills|full [--number 1000] [--seed 2301]

bags   mutated recordings (.bag plain and lz4, .mcap plain and zstd, .db3): inspected, read, each tenth mapped. Bad is a traceback, more than 60 s,
       more than 1.5 GB, or messages that are neither used nor counted.
maps   mutated map files: refused, or equal to what was written.
kills  a process that saves maps is killed (SIGKILL) at a random moment: the file is the old or the new map, and the next save leaves nothing else.
full   the file system refuses to write on: the same, and the error is one line.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader

from topograph import store
from topograph.bags import Recording
from topograph.config import Config
from topograph.errors import TopographError
from topograph.pipeline import audited, inspect_bags, read_run, solve_run, topo_map
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.topomap import Seen, TopoMap

FORMATS = ("none.bag", "lz4.bag", "none.mcap", "zstd.mcap", "rows.db3")
LONGEST_S, LARGEST_MB = 60.0, 1500.0


def bases(folder: Path, seed: int) -> dict[str, Path]:
    """A small run in every format."""
    out = {}
    for suffix in ("bag", "mcap"):
        run = folder / ("run.bag" if suffix == "bag" else "run")
        record(run, seed, "grid", DriveConfig(longest_s=15.0), SensorConfig(detections=True))
        for name in (n for n in FORMATS if n.endswith(suffix) or (suffix == "mcap" and n.endswith("db3"))):
            out[name] = copy(run, folder, name)
    return out


def copy(run: Path, folder: Path, name: str) -> Path:
    """A recording anew as COMPRESSION.bag, COMPRESSION.mcap (in chunks of 64 KB) or NAME.db3; ROS 1 for .bag, ROS 2 for the others."""
    compression, suffix = name.split(".")
    out = folder / name
    with AnyReader([run]) as r:
        if suffix == "mcap":
            with out.open("wb") as f:
                mcap = McapWriter(f, chunk_size=1 << 16, compression=CompressionType[compression.upper()])
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
        writer: Any
        if suffix == "bag":
            writer = rosbag1.Writer(out)
            writer.chunk_threshold = 1 << 16
            if compression != "none":
                writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        else:
            writer = rosbag2.Writer(folder / compression, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
        with writer:
            to = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=r.typestore) for c in r.connections}
            for c, t, raw in r.messages():
                writer.write(to[c.id], t, raw)
    if suffix == "db3":
        (folder / compression / f"{compression}.db3").rename(out)
    return out


def mutate(data: bytes, rng: np.random.Generator, mode: int) -> bytes:
    """Scattered bytes, a hole of zeros, an end cut off, a piece cut out, a byte of the head, a piece twice."""
    b = bytearray(data)
    n = len(b)
    at, length = int(rng.integers(n)), int(rng.integers(1, 5000))
    if mode == 0:
        for k in rng.integers(0, n, 1 + rng.integers(20)):
            b[k] = int(rng.integers(256))
    elif mode == 1:
        b[at : at + length] = bytes(min(length, n - at))
    elif mode == 2:
        del b[at:]
    elif mode == 3:
        del b[at : at + length]
    elif mode == 4:
        b[int(rng.integers(min(n, 4000)))] = int(rng.integers(256))
    else:
        b[at:at] = b[at : at + length]
    return bytes(b)


Result = tuple[str, int, str, float, float]
"""File, number, what came of it, s, MB."""


def one(source: Path, k: int, rng: np.random.Generator, folder: Path, read: Callable[[Path], str]) -> Result:
    """A mutated copy of a file, and what `read` says of it."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(dir=folder) as at:
        path = Path(at) / source.name
        path.write_bytes(mutate(source.read_bytes(), rng, k % 6))
        try:
            said = read(path)
        except TopographError:
            said = "refused"
        except Exception as err:  # noqa: BLE001  # what is looked for
            where = traceback.extract_tb(err.__traceback__)[-1]
            said = f"TRACEBACK {type(err).__name__}: {err} ({Path(where.filename).name}:{where.lineno})"
    mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return source.name, k, said, time.monotonic() - began, mb


def one_bag(job: tuple[Path, int, int, Path]) -> Result:
    source, k, seed, folder = job

    def read(path: Path) -> str:
        inspect_bags([path], Config())
        with Recording([path]) as r:
            announced = sum(r.counts[t] for t in r.chosen.values())
        run = read_run([path], Config())
        s = run.streams
        used = len(s.odometry_ns) + len(s.imu_ns) + len(s.fix_ns) + len(s.heading_ns) + len(run.trunks)
        missing = announced - used - sum(n for why, n in run.skipped.items() if not why.startswith("tf"))
        more = missing < 0 and any("sequence" in n or "announced" in n for n in run.notes)  # than the index announced
        if k % 10 == 0:
            solved = solve_run(run, Config())
            topo_map(solved, Config(), {})
            audited(solved)
        return "read" if missing == 0 or more else f"LOST {missing}"

    return one(source, k, np.random.default_rng([seed, k, sum(map(ord, source.name))]), folder, read)


def one_map(job: tuple[Path, int, int, Path]) -> Result:
    source, k, seed, folder = job
    whole = store.load(source)

    def read(path: Path) -> str:
        return "read" if same(store.load(path), whole) else "WRONG CLAIM: not what was written"

    return one(source, k, np.random.default_rng([seed, k]), folder, read)


def same(a: TopoMap | Seen, b: TopoMap | Seen) -> bool:
    """Every field; poses are kept as quaternions, which costs the last bit."""
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if f.name == "viewpoints":
            if len(x) != len(y) or any(not np.array_equal(p.cloud, q.cloud) for p, q in zip(x, y, strict=True)):
                return False
        elif isinstance(x, Seen):
            if not same(x, y):
                return False
        elif isinstance(x, np.ndarray):
            if x.shape != y.shape or not np.allclose(x, y, rtol=0.0, atol=1e-12, equal_nan=x.dtype.kind == "f"):
                return False
        elif x != y:
            return False
    return True


def a_map(folder: Path, seed: int) -> TopoMap:
    run = folder / "m"
    record(run, seed, "grid", DriveConfig(longest_s=15.0), SensorConfig(detections=True))
    read = read_run([run], Config())
    return topo_map(solve_run(read, Config()), Config(), {})


def _aftermath(path: Path, old: TopoMap, out: Counter[str]) -> None:
    """What is found after a save that did not end: a whole map, and nothing beside it once another was saved."""
    try:
        whole = same(replace(store.load(path), meta={}), replace(old, meta={}))
        out["a whole map" if whole else "TORN"] += 1
    except TopographError as err:
        out[f"LOST: {err}"] += 1
    with store.locked(path):
        store.save(old, path)
    stray = sorted(
        p.name
        for p in path.parent.iterdir()
        if "map" in p.name and p.name != "map.gpkg" and not p.name.endswith(".lock")
    )
    out["STRAY " + " ".join(stray) if stray else "nothing stray"] += 1


def kills(number: int, seed: int, folder: Path) -> Counter[str]:
    """Children save an old and a new map by turns until they are killed."""
    rng = random.Random(seed)
    old = a_map(folder, seed)
    new = replace(old, meta={**old.meta, "which": "new"})
    path = folder / "map.gpkg"
    store.save(old, path)
    old = store.load(path)
    out: Counter[str] = Counter()
    for _ in range(number):
        child = os.fork()
        if child == 0:
            while True:
                with store.locked(path):
                    store.save(new, path)
                    store.save(old, path)
        time.sleep(rng.uniform(0.0, 0.12))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        _aftermath(path, old, out)
    return out


def full(number: int, seed: int, folder: Path) -> Counter[str]:
    """Children may write so many bytes to a file and not one more."""
    rng = random.Random(seed)
    old = a_map(folder, seed)
    path = folder / "map.gpkg"
    store.save(old, path)
    old = store.load(path)
    size = path.stat().st_size
    out: Counter[str] = Counter()
    for _ in range(number):
        limit = rng.randrange(int(0.95 * size))  # before the fork: the child's generator ends with it
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            try:
                with store.locked(path):
                    store.save(replace(old, meta={"which": "new"}), path)
                os._exit(0)
            except (TopographError, OSError):
                os._exit(3)
            except BaseException:  # noqa: BLE001  # what is looked for
                traceback.print_exc()
                os._exit(4)
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        out[{0: "WRITTEN beyond the limit", 3: "refused in one line"}.get(code, f"TRACEBACK (exit {code})")] += 1
        _aftermath(path, old, out)
    return out


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("what", choices=("bags", "maps", "kills", "full"))
    p.add_argument("--number", type=int, default=0, help="of files (per kind of recording), kills or writes")
    p.add_argument("--seed", type=int, default=2301)
    a = p.parse_args()
    number = a.number or {"bags": 1000, "maps": 1000, "kills": 200, "full": 50}[a.what]
    with tempfile.TemporaryDirectory() as at:
        folder = Path(at)
        if a.what in ("kills", "full"):
            for what, n in sorted((kills if a.what == "kills" else full)(number, a.seed, folder).items()):
                print(f"{n:>5}  {what}")
            return
        if a.what == "maps":
            store.save(a_map(folder, a.seed), folder / "whole.gpkg")
            jobs = [(folder / "whole.gpkg", k, a.seed, folder) for k in range(number)]
        else:
            share = {"bag": 2, "mcap": 2, "db3": 1}
            jobs = [
                (f, k, a.seed, folder)
                for n, f in bases(folder, a.seed).items()
                for k in range(number // share[n.split(".")[1]])
            ]
        with ProcessPoolExecutor(2, mp_context=get_context("spawn"), max_tasks_per_child=400) as pool:
            out = list(pool.map(one_map if a.what == "maps" else one_bag, jobs, chunksize=8))
        shutil.rmtree(folder / "run", ignore_errors=True)
    for name, n in sorted(Counter((o[0], o[2].split()[0]) for o in out).items()):
        print(f"{n:>5}  {name[0]:<12} {name[1]}")
    for o in out:
        if o[2].split()[0] not in ("read", "refused") or o[3] > LONGEST_S or o[4] > LARGEST_MB:
            print(f"  {o[0]} {o[1]}: {o[2]} ({o[3]:.1f} s, {o[4]:.0f} MB)")
    print(f"slowest {max(o[3] for o in out):.1f} s, largest {max(o[4] for o in out):.0f} MB, seed {a.seed}")


if __name__ == "__main__":
    main()
