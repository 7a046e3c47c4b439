"""Suffix -> writer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from topograph.errors import UsageError
from topograph.exchange.clouds import write_laz, write_pcd, write_ply
from topograph.exchange.graphs import write_graphml
from topograph.exchange.localized import Localized
from topograph.exchange.ros import write_ros
from topograph.exchange.rrd import write_rrd
from topograph.exchange.tables import write_csv, write_geojson, write_kml, write_parquet
from topograph.exchange.tum import write_tum
from topograph.topomap import TopoMap
from topograph.whole import whole


def _path(topo: TopoMap, path: Path) -> None:
    if not len(topo.stamps_ns):
        raise UsageError("the map has no path: it was made of surveyed trees")
    with whole(path) as part:
        write_tum(part, topo.stamps_ns, topo.map_T_robot)


WRITERS: dict[str, tuple[Callable[[TopoMap, Path], None], str, bool]] = {
    ".geojson": (write_geojson, "trees (QGIS, geojson.io)", False),
    ".csv": (write_csv, "trees as a table", False),
    ".kml": (write_kml, "trees and path for Google Earth", False),
    ".parquet": (write_parquet, "trees as GeoParquet (needs topograph[exchange])", False),
    ".graphml": (write_graphml, "the graph (networkx, Gephi, yEd)", False),
    ".tum": (_path, "the path (evo)", False),
    ".ply": (write_ply, "clouds (CloudCompare, MeshLab)", True),
    ".pcd": (write_pcd, "clouds (PCL)", True),
    ".las": (write_laz, "clouds (needs topograph[exchange])", True),
    ".laz": (write_laz, "clouds, compressed (needs topograph[exchange])", True),
    ".mcap": (write_ros, "markers, path and clouds for Foxglove and RViz 2", True),
    ".bag": (write_ros, "the same for RViz (ROS 1)", True),
    ".rrd": (write_rrd, "trees, path and clouds for Rerun (needs topograph[rerun])", True),
}
"""Suffix -> writer, what it writes, whether it needs the clouds."""
REPLAYS = (".mcap", ".bag")
"""Formats that a localization can be put into."""


def write(topo: TopoMap, path: Path | str, localized: Localized | None = None) -> None:
    """Write the map by the suffix of `path`, whole or not at all; with a localization to replay where the format has time (`REPLAYS`).

    Raises:
        UsageError: another suffix, a format that the map cannot fill, or an extra that is not installed.
    """
    path = Path(path)
    if not len(topo):
        raise UsageError("the map is empty: there is nothing to write")
    if path.suffix not in WRITERS:
        raise UsageError(f"{path}: end the name in one of {', '.join(WRITERS)}")
    if localized is not None:
        if path.suffix not in REPLAYS:
            raise UsageError(f"{path}: a localization is replayed in {' or '.join(REPLAYS)}")
        write_ros(topo, path, localized)
        return
    WRITERS[path.suffix][0](topo, path)
