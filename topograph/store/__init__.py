"""TopoMap <-> one OGC GeoPackage, which QGIS opens as it is. Written whole or not at all."""

from topograph.store.lock import locked
from topograph.store.reading import clouds_near, load
from topograph.store.schema import SCHEMA_VERSION
from topograph.store.writing import save

__all__ = ["SCHEMA_VERSION", "clouds_near", "load", "locked", "save"]
