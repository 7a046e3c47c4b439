"""Trees as tables: a map to geopandas, and a surveyed tree list as a map to localize in:  python examples/tables.py survey.geojson later.bag"""

import sys

import geopandas
import pandas

from topograph import TopoMap, localize_bags
from topograph.exchange import geodataframe, topomap_of


def thick_and_leaning(orchard: TopoMap) -> pandas.DataFrame:
    """Trees of more than 20 cm that lean by more than 5°, with their addresses."""
    frame = geodataframe(orchard.trees())
    return frame[(frame["diameter"] > 0.2) & (frame["axis_z"] < 0.996)][["place", "diameter", "geometry"]]


def main(survey: str, later: str) -> None:
    """Trees that somebody has surveyed, to 5 cm, are map enough to be found in."""
    orchard = topomap_of(geopandas.read_file(survey), sigma=0.05)
    replay = localize_bags(orchard, later)
    for fix in replay.fixes[::50]:
        x, y = fix.map_T_robot[:2, 3]
        print(f"{fix.stamp_ns * 1e-9:.1f} s: x {x:.2f} m, y {y:.2f} m, risk {fix.risk:.1e}")


if __name__ == "__main__":
    main(*sys.argv[1:3])
