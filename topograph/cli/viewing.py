"""`topograph view`."""

from __future__ import annotations

import json
import threading
import webbrowser
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import click

from topograph.cli.common import check_output, hash_of, main
from topograph.errors import TopographError, UsageError


@main.command()
@click.argument("map_file", metavar="MAP", type=click.Path(path_type=Path))
@click.argument("output", required=False, type=click.Path(path_type=Path))
@click.option(
    "--html",
    type=click.Path(path_type=Path),
    help="Write one self-contained page to send to somebody (the same as OUTPUT).",
)
@click.option(
    "--localization", type=click.Path(path_type=Path), help="Results folder of `localize`: replayed on the map."
)
@click.option("--force", is_flag=True, help="Replace the page if it is there.")
@click.option("--serve", is_flag=True, help="Serve the page on 127.0.0.1, clouds on demand, until Ctrl-C.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of --serve; any free one by default.")
@click.option("--open/--no-open", "open_it", default=False, help="Open the page in the browser.")
def view(
    map_file: Path, output: Path | None, html: Path | None, localization: Path | None, force: bool, serve: bool, port: int, open_it: bool
) -> None:  # fmt: skip
    """Walk through MAP in a browser, offline: trees, ellipses, edges, clouds from each side, a localization replayed.

    Without --serve one self-contained page is written: OUTPUT, or MAP's name with .html.
    """
    from topograph import store
    from topograph.report.viewer import localization_data, page, write_viewer

    if output is not None and html is not None:
        raise UsageError("OUTPUT and --html name the same page: give one of them")
    target = output or html or Path(map_file.name).with_suffix(".html")
    if serve and (output or html):
        raise UsageError("--serve writes no page: leave the name out")
    if not serve:
        check_output(target, [map_file], (".html", ".htm"))
        if not target.parent.is_dir():
            raise UsageError(f"{target}: there is no folder {target.parent}")
        if target.exists() and not force:
            raise UsageError(f"{target}: is there already; --force replaces it")
    topo = store.load(map_file, clouds=not serve)
    notes = [] if topo.datum is not None else ["not georeferenced: the frame is the first pose of the run"]
    if topo.meta.get("verdict", "sound") not in ("sound", ""):
        why = topo.meta.get("why", "")
        notes.append(f"the audit called this map {topo.meta['verdict']}" + (f": {why}" if why else ""))
    replay = None if localization is None else localization_data(localization, topo)
    if localization is not None and not of_this_map(localization, map_file):
        notes.append(f"{localization} was localized in another map, or in another state of this one")
        click.echo(f"note: {notes[-1]}", err=True)
    if not serve:
        write_viewer(target, topo, map_file.name, notes=notes, localization=replay)
        click.echo(f"written: {target} ({target.stat().st_size / 1e6:.1f} MB, opens without network)")
        if open_it:
            webbrowser.open(target.resolve().as_uri())
        return
    text = page(topo, map_file.name, notes=notes, localization=replay, served=True).encode()
    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), _handler(text, map_file, topo))
    except OSError as err:
        raise UsageError(f"--port {port}: {err.strerror}; another one, or none for any that is free") from err
    address = f"http://127.0.0.1:{server.server_address[1]}/"
    click.echo(f"{address} (Ctrl-C ends)")
    if open_it:
        webbrowser.open(address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        click.echo("ended", err=True)
    finally:
        server.server_close()


def of_this_map(folder: Path, map_file: Path) -> bool:
    """The results in `folder` are of this very file; where they do not say so, they are believed."""
    try:
        inputs = json.loads((folder / "report.json").read_text())["inputs"]
        known = [i["sha256"] for i in inputs if i["path"].endswith(".gpkg")]
    except (OSError, ValueError, KeyError, TypeError):
        return True
    return not known or hash_of(map_file, threading.Event()) in known


def _handler(text: bytes, map_file: Path, topo: Any) -> type[BaseHTTPRequestHandler]:
    """Answers for the page and for the clouds of a tree, and for nothing else."""
    from topograph import store
    from topograph.report.viewer import millimetres

    row = {int(t): k for k, t in enumerate(topo.ids)}

    @lru_cache(maxsize=64)
    def clouds(tree: int) -> bytes:
        near = store.clouds_near(map_file, topo.p[row[tree], :2], 1e-3)
        views = [
            {"dx": float(v[0]), "dy": float(v[1]), "cloud": millimetres(cloud).tolist()}
            for t, v, cloud in near
            if t == tree
        ]
        return json.dumps(views).encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            word = self.path.removeprefix("/clouds/")
            host = self.headers.get("Host", "").rpartition(":")[0]
            if host not in ("127.0.0.1", "localhost"):  # a page of another name that points here
                self.send_error(403)
            elif self.path in ("/", "/index.html"):
                self._send(text, "text/html; charset=utf-8")
            elif (
                self.path.startswith("/clouds/")
                and word.isascii()
                and word.isdigit()
                and len(word) < 10
                and int(word) in row
            ):
                try:
                    self._send(clouds(int(word)), "application/json")
                except TopographError as err:
                    self.send_error(500, str(err))
            else:
                self.send_error(404)

        def _send(self, body: bytes, kind: str) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            """Silent: the terminal is the user's."""

    return Handler
