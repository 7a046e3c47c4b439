"""Where on a map of trees is what was seen: one search, for the mapper's loops, for localization, and for runs that extend a map."""

from topograph.places.config import PlacesConfig
from topograph.places.evidence import Placements, placements
from topograph.places.index import MapIndex, build_index, irregularity
from topograph.places.search import Found, Landmarks, search, searching, spread
from topograph.places.search_kernels import Prior

__all__ = [
    "Found",
    "Landmarks",
    "MapIndex",
    "Placements",
    "PlacesConfig",
    "Prior",
    "build_index",
    "irregularity",
    "placements",
    "search",
    "searching",
    "spread",
]
