"""A format of one's own:  python examples/own_exporter.py orchard.gpkg trees.gpx"""

import sys
from pathlib import Path
from xml.sax.saxutils import escape

from topograph import TopoMap, export_map, load_map
from topograph.exchange import WRITERS


def write_gpx(topo: TopoMap, path: Path) -> None:
    """Trees as waypoints, for a handheld GPS receiver."""
    if topo.datum is None:
        raise SystemExit("the map is not georeferenced")
    topo = topo.trees()
    points = [
        f'<wpt lat="{lat:.8f}" lon="{lon:.8f}"><ele>{h:.2f}</ele><name>{escape(place or str(tree))}</name></wpt>'
        for (lat, lon, h), place, tree in zip(topo.geodetic(), topo.place, topo.ids, strict=True)
    ]
    path.write_text(
        f'<gpx version="1.1" creator="topograph" xmlns="http://www.topografix.com/GPX/1/1">{"".join(points)}</gpx>\n'
    )


WRITERS[".gpx"] = (write_gpx, "trees as waypoints", False)

if __name__ == "__main__":
    export_map(load_map(sys.argv[1], clouds=False), Path(sys.argv[2]))
