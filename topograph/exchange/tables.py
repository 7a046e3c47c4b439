"""Trees as tables and features: CSV, GeoJSON, KML, GeoParquet."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from topograph.errors import InputError, UsageError
from topograph.exchange.attributes import columns
from topograph.geometry import Datum
from topograph.topomap import TopoMap
from topograph.whole import whole


def write_csv(topo: TopoMap, path: Path) -> None:
    """One row a landmark; empty where a value is not known."""
    c = columns(topo)
    with whole(path) as part, part.open("w", newline="") as f:
        writer = csv.writer(f)
        writer.writerow(c)
        writer.writerows(zip(*c.values(), strict=True))


def write_geojson(topo: TopoMap, path: Path) -> None:
    """Points (RFC 7946): longitude, latitude, height."""
    c = columns(georeferenced(topo, "GeoJSON"))
    features = [
        {
            "type": "Feature",
            "id": c["id"][i],
            "geometry": {"type": "Point", "coordinates": [c["lon"][i], c["lat"][i], c["h"][i]]},
            "properties": {k: v[i] for k, v in c.items() if k not in ("lat", "lon", "h")},
        }
        for i in range(len(topo))
    ]
    with whole(path) as part:
        part.write_text(json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n")


KML = "http://www.opengis.net/kml/2.2"


def write_kml(topo: TopoMap, path: Path) -> None:
    """Placemarks (OGC KML 2.2) named by their address, and the path as a line."""
    c = columns(georeferenced(topo, "KML"))
    ET.register_namespace("", KML)
    root = ET.Element(f"{{{KML}}}kml")
    document = ET.SubElement(root, f"{{{KML}}}Document")
    for i in range(len(topo)):
        mark = ET.SubElement(document, f"{{{KML}}}Placemark")
        ET.SubElement(mark, f"{{{KML}}}name").text = c["place"][i] or str(c["id"][i])
        data = ET.SubElement(mark, f"{{{KML}}}ExtendedData")
        for k, v in c.items():
            if v[i] is not None and k not in ("lat", "lon", "h"):
                ET.SubElement(ET.SubElement(data, f"{{{KML}}}Data", name=k), f"{{{KML}}}value").text = str(v[i])
        point = ET.SubElement(mark, f"{{{KML}}}Point")
        ET.SubElement(point, f"{{{KML}}}coordinates").text = f"{c['lon'][i]!r},{c['lat'][i]!r},{c['h'][i]!r}"
    if topo.datum is not None and len(topo.stamps_ns):
        track = ET.SubElement(document, f"{{{KML}}}Placemark")
        ET.SubElement(track, f"{{{KML}}}name").text = "path"
        line = ET.SubElement(track, f"{{{KML}}}LineString")
        g = topo.datum.to_geodetic(topo.map_T_robot[:, :3, 3])
        text = " ".join(f"{lon!r},{lat!r},{h!r}" for lat, lon, h in g.tolist())
        ET.SubElement(line, f"{{{KML}}}coordinates").text = text
    with whole(path) as part:
        ET.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)


def write_parquet(topo: TopoMap, path: Path) -> None:
    """GeoParquet, by geopandas."""
    try:
        import pyarrow  # noqa: F401  # geopandas looks for it when it writes
    except ImportError as err:
        raise UsageError("GeoParquet needs geopandas and pyarrow: pip install 'topograph[exchange]'") from err
    frame = geodataframe(topo)
    with whole(path) as part:
        frame.to_parquet(part)


def geodataframe(topo: TopoMap) -> Any:
    """The landmarks as a geopandas GeoDataFrame, EPSG:4326 with heights, or in the map's own frame without a datum.

    Raises:
        UsageError: geopandas is not installed.
    """
    try:
        import geopandas
    except ImportError as err:
        raise UsageError("GeoParquet needs geopandas and pyarrow: pip install 'topograph[exchange]'") from err
    c = columns(topo)
    there = ("lon", "lat", "h") if topo.datum is not None else ("x", "y", "z")
    points = geopandas.points_from_xy(*(c[k] for k in there))
    return geopandas.GeoDataFrame(
        {k: v for k, v in c.items() if k not in ("lon", "lat", "h")},
        geometry=points,
        crs=4326 if topo.datum is not None else None,
    )


def topomap_of(frame: Any, sigma: float = 0.05) -> TopoMap:
    """A map of surveyed trees to localize in: a GeoDataFrame of points in any CRS, with a column `diameter` (m) where it is known, each
    known to `sigma` m. Without a CRS its x and y are metres in a frame of their own.

    Raises:
        InputError: no trees, what is no point, no number, not on Earth, or no diameter in metres.
    """
    if not len(frame):
        raise InputError("no trees in the table")
    if "kind" in frame:  # a map that was written by `geodataframe`: posts are no trees
        frame = frame[frame["kind"] == "tree"]
    if not (frame.geometry.geom_type == "Point").all():
        raise InputError("trees are points: of polygons, such as crowns, take the centroids first")
    datum = None
    if frame.crs is None:
        z = np.where(frame.geometry.has_z, frame.geometry.z, 0.0)
        p = np.column_stack([frame.geometry.x, frame.geometry.y, z])
    else:
        g = frame.geometry.to_crs(4326)
        if not ((np.abs(g.y) <= 90.0) & (np.abs(g.x) <= 180.0)).all():
            raise InputError("a tree's latitude or longitude is none: is the CRS the right one?")
        h = np.nan_to_num(np.where(g.has_z, g.z, 0.0))
        datum = Datum(float(np.median(g.y)), float(np.median(g.x)), float(np.median(h)))
        p = datum.to_enu(np.column_stack([g.y, g.x, h]))
    if not np.isfinite(p).all():
        raise InputError("a tree's place is not a number")
    if np.ptp(p, axis=0).max() > WIDEST_M:
        raise InputError(
            f"the trees lie {np.ptp(p, axis=0).max() / 1000:.0f} km apart: is one of them on the other side of the date line?"
        )
    try:
        diameter = frame["diameter"].to_numpy(float) if "diameter" in frame else np.full(len(frame), np.nan)
    except (TypeError, ValueError) as err:
        raise InputError(f"a diameter is not a number ({err})") from err
    if ((diameter <= 0.0) | (diameter > THICKEST_M)).any():
        raise InputError(
            f"diameters are metres, from 0 to {THICKEST_M:g}: {np.nanmax(np.abs(diameter)):g} is none (centimetres?)"
        )
    return replace(TopoMap.of_points(p[:, :2], sigma), p=p, datum=datum, diameter=diameter)


WIDEST_M, THICKEST_M = 1e5, 5.0
"""Of an orchard, and of a trunk."""


def georeferenced(topo: TopoMap, what: str) -> TopoMap:
    """The map, if it has a place on Earth.

    Raises:
        UsageError: it has none.
    """
    if topo.datum is None:
        raise UsageError(f"the map is not georeferenced: {what} needs longitude and latitude; export .csv instead")
    return topo
