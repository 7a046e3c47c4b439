"""What all commands share: errors to exit codes, input options, progress, results' folder."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import logging
import math
import os
import platform
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import click

from topograph import __version__
from topograph.cli.help import Command, write_examples
from topograph.errors import InputError, TopographError, UsageError

_F = TypeVar("_F", bound=Callable[..., Any])

_TOPICS = ("points", "trunks", "odometry", "imu", "fix", "heading")


class Terminated(BaseException):
    """SIGTERM."""


def _end(*_: Any) -> None:
    raise Terminated


class _Group(click.Group):
    """Turns errors into one line on stderr and their exit code."""

    command_class = Command

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        write_examples("topograph", formatter)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except TopographError as err:
            click.echo(f"topograph: {err}", err=True)
            ctx.exit(err.exit_code)
        except (click.exceptions.ClickException, click.exceptions.Exit, click.exceptions.Abort, SystemExit):
            raise
        except BrokenPipeError:
            os._exit(0)
        except KeyboardInterrupt:
            click.echo("topograph: stopped by hand; nothing half done was left", err=True)
            ctx.exit(130)
        except Terminated:
            click.echo("topograph: told to end; nothing half done was left", err=True)
            ctx.exit(143)
        except MemoryError:
            click.echo(
                "topograph: not enough memory for this recording; map a part of it with --from and --to", err=True
            )
            ctx.exit(1)
        except OSError as err:
            click.echo(f"topograph: {err.filename or 'a file'}: {err.strerror or err}", err=True)
            full = err.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            ctx.exit(TopographError.exit_code if full else InputError.exit_code)
        except Exception as err:
            if ctx.params.get("verbose"):
                raise
            click.echo(f"topograph: unexpected, please report: {type(err).__name__}: {err} (-v shows where)", err=True)
            ctx.exit(TopographError.exit_code)


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Of glibc's mallopt(3)."""


LARGE, KEPT = 4 << 20, 32 << 20
"""Bytes from which on an array has pages of its own; what stays with the heap when it is freed, for the next sweep."""


def thrifty() -> None:
    """glibc keeps a heap for each thread, and what a solver's thread has freed is never given to the others; and it learns to put arrays
    of up to 32 MB on the heap, where they leave holes: together a sixth of the peak.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(M_ARENA_MAX, 1)
        libc.mallopt(M_MMAP_THRESHOLD, LARGE)
        libc.mallopt(M_TRIM_THRESHOLD, KEPT)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
@click.option("-v", "--verbose", is_flag=True, help="Say what happens inside.")
def main(verbose: bool) -> None:
    """Topological maps of orchards from robot recordings, by factor graph."""
    thrifty()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _end)
    logging.basicConfig(level=logging.WARNING if verbose else logging.ERROR, format="%(name)s: %(message)s")
    logging.getLogger("topograph").setLevel(logging.DEBUG if verbose else logging.WARNING)


def check_accepted(accept: Sequence[str]) -> None:
    from topograph.audit import REFUSING

    unknown = sorted(set(accept) - set(REFUSING))
    if unknown:
        raise UsageError(f"--accept {unknown[0]}: nothing is refused for that; known are {', '.join(REFUSING)}")


def check_target(target: Path) -> None:
    if target.suffix != ".gpkg":
        raise UsageError(f"{target}: a map is a GeoPackage; end its name in .gpkg")
    if target.is_dir():
        raise UsageError(f"{target}: is a folder; name a file that ends in .gpkg")


def say_if_cold(quiet: bool = False) -> None:
    """Say so before the first run of an installation compiles: it would seem to hang."""
    own = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(own) if own else Path(__file__).parent.parent / "trunks"
    if not quiet and not any(folder.rglob("fit.fit_chains*.nbi")):
        click.echo(
            "the first run of an installation compiles for half a minute or more (`topograph warm` does it ahead)",
            err=True,
        )


jobs_option = click.option(
    "--jobs",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Processes that detect; the result is the same.",
)


def span_options(f: _F) -> _F:
    """--from and --to: the part of a recording that is read."""
    f = click.option("--to", "to_s", type=float, default=float("inf"), help="End there.")(f)
    return click.option("--from", "from_s", type=float, default=0.0, help="Begin so many seconds into the recording.")(
        f
    )


def input_options(f: _F) -> _F:
    for kind in reversed(_TOPICS):
        f = click.option(f"--topic-{kind}", default=None, metavar="TOPIC", help=f"Topic of {kind}; 'none' ignores it.")(
            f
        )
    f = click.option(
        "--front-end", type=click.Choice(["organised", "thesis"]), default=None,
        help="How trunks are found: ours (organised), or the thesis's pipeline (Algorithms 1-2) to compare with.",
    )(f)  # fmt: skip
    f = click.option(
        "--strict", is_flag=True, help="Refuse truncated or damaged recordings, instead of reading what is whole."
    )(f)
    f = click.option("--base-frame", default=None, help="Frame whose poses are estimated (base_link).")(f)
    f = click.option(
        "--extrinsic", multiple=True, metavar="FRAME=X,Y,Z,R,P,Y",
        help="Mounting of a sensor in the base frame, metres and radians; repeat for more.",
    )(f)  # fmt: skip
    return click.option(
        "-c", "--config", "config_file", type=click.Path(path_type=Path), help="YAML of `topograph config`."
    )(f)


def config_of(config_file: Path | None, words: dict[str, Any]) -> Any:
    from topograph.config import load

    overrides: dict[str, Any] = {}
    for kind in _TOPICS:
        if words.get(f"topic_{kind}"):
            overrides[f"bags.topic_{kind}"] = words[f"topic_{kind}"]
    if words.get("front_end"):
        overrides["trunks.front_end"] = words["front_end"]
    if words.get("strict"):
        overrides["bags.strict"] = True
    if words.get("base_frame"):
        overrides["bags.base_frame"] = words["base_frame"]
    mounts = {}
    for word in words.get("extrinsic") or ():
        frame, _, numbers = word.partition("=")
        try:
            values = tuple(float(x) for x in numbers.split(","))
        except ValueError:
            values = ()
        if len(values) != 6 or not frame or not all(map(math.isfinite, values)):
            raise UsageError(f"--extrinsic {word}: give FRAME=X,Y,Z,ROLL,PITCH,YAW, metres and radians")
        mounts[frame] = values
    if mounts:
        overrides["bags.extrinsics"] = mounts
    return load(config_file, overrides)


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """A bar with rate and time left on a terminal; a line per stage elsewhere."""
    if quiet or not sys.stderr.isatty():
        said: dict[str, int] = {}
        began = time.monotonic()

        def plain(stage: str, share: float) -> None:
            step = int(4 * share)
            if not quiet and said.get(stage, -1) < step:
                said[stage] = step
                click.echo(f"{stage}: {100 * share:.0f} % ({time.monotonic() - began:.0f} s)", err=True)

        yield plain
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:>16}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"),
               TimeElapsedColumn(), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, Any] = {}

        def show(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=1.0)
            bar.update(tasks[stage], completed=share)

        yield show


@contextmanager
def results_folder(folder: Path | None) -> Iterator[Path]:
    """The folder for a run's results; without a name results/<stamp>. `latest` points there once it holds something; a command that
    fails leaves no empty folder."""
    given = folder is not None
    root = Path("results")
    if not given and (root / "latest").is_dir() and not (root / "latest").is_symlink():
        raise UsageError(
            "results/latest is a folder, not the link that this program makes: move it away, or give --results"
        )
    out = folder if folder is not None else root / datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S_%f")
    made = [p for p in (out, *out.parents) if not p.exists()]
    out.mkdir(parents=True, exist_ok=True)
    try:
        yield out
    except BaseException:
        for p in made:
            if p.is_dir() and not any(p.iterdir()):
                p.rmdir()
        raise
    if not given:
        link, part = root / "latest", root / f".latest.{os.getpid()}"
        part.unlink(missing_ok=True)
        part.symlink_to(out.name)
        part.replace(link)


HASHED_AT_ONCE = 1 << 18
"""Bytes of a file: what the processor keeps near."""


def hash_of(path: Path, stop: threading.Event) -> str:
    """SHA-256 of a file, or of a folder's files in order of name; of what was read until `stop`."""
    h = hashlib.sha256()
    block = memoryview(bytearray(HASHED_AT_ONCE))
    for p in [path] if path.is_file() else sorted(q for q in path.rglob("*") if q.is_file()):
        with p.open("rb", buffering=0) as f:
            while not stop.is_set() and (n := f.readinto(block)):
                h.update(block[:n])
    return h.hexdigest()


def check_output(output: Path | None, inputs: Sequence[Path], suffixes: Sequence[str]) -> None:
    """Raise UsageError where a result would be written over an input, or under a name that says otherwise."""
    if output is None:
        return
    if output.resolve() in {p.resolve() for p in inputs}:
        raise UsageError(f"{output}: is an input; nothing is written over it")
    if output.suffix not in suffixes:
        raise UsageError(f"{output}: end the name in {' or '.join(suffixes)}")


@contextmanager
def hashed(paths: Sequence[Path], whole: bool = True) -> Iterator[Callable[[], list[dict[str, str]]]]:
    """Names and hashes of files, computed beside the reading: what one of the two has read, the other finds in memory. Not `whole`, a
    part is read, and its file is told by its size.
    """
    if not whole:
        yield lambda: [{"path": p.name, "bytes": str(p.stat().st_size)} for p in paths if p.exists()]
        return
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        waiting = [(p.name, pool.submit(hash_of, p, stop)) for p in paths if p.exists()]
        try:
            yield lambda: [{"path": name, "sha256": w.result()} for name, w in waiting]
        finally:
            stop.set()  # a command that fails does not wait for it


def versions() -> dict[str, str]:
    names = ("gtsam", "numpy", "scipy", "numba", "rosbags")
    return {
        "topograph": __version__,
        "python": platform.python_version(),
        **{n: metadata.version(n) for n in names},
    }


WHOLE = (0.0, math.inf)
"""From and to, s: all of a recording."""


def span_facts(span_s: tuple[float, float]) -> dict[str, str]:
    """What a page says of a part of a recording; nothing of the whole."""
    return {} if span_s == WHOLE else {"of which": f"{span_s[0]:g} to {span_s[1]:g} s"}


def plain_span(span_s: tuple[float, float]) -> list[float | None]:
    """From and to (s) as JSON has them."""
    return [s if math.isfinite(s) else None for s in span_s]


def peak_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024 if sys.platform != "darwin" else peak / 1024**2


TRUTH = (
    "Truth to compare with: a simulator's folder, a .tum path, or trees as .csv or .geojson; twice for trees and path."
)


def truth_of(paths: Sequence[Path]) -> Any:
    """The truth that was named; none is looked for: an estimator must not find it by itself."""
    from topograph.evaluate import read_truth

    return read_truth(paths)


def table(metrics: Sequence[Any]) -> None:
    from topograph.report.page import show

    for m in metrics:
        click.echo(f"  {m.name:<38} {show(m):>12}")
