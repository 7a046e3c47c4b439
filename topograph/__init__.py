"""Topological maps of orchards from robot recordings, by factor graph.

>>> from topograph import load_map, map_bags, localize_bags           # doctest: +SKIP
>>> orchard = map_bags("run.bag")                                     # doctest: +SKIP
>>> orchard.trees().geodetic()                                        # doctest: +SKIP
>>> [fix.map_T_robot for fix in localize_bags(orchard, "later.bag").fixes]   # doctest: +SKIP

Names are loaded when they are asked for: importing the package costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from topograph.config import Config
    from topograph.exchange import write as export_map
    from topograph.localize import Localizer
    from topograph.mapping import Mapper
    from topograph.pipeline.face import load_map, localize_bags, map_bags, save_map
    from topograph.topomap import TopoMap

_WHERE = {
    "Config": ("topograph.config", "Config"),
    "Localizer": ("topograph.localize", "Localizer"),
    "Mapper": ("topograph.mapping", "Mapper"),
    "TopoMap": ("topograph.topomap", "TopoMap"),
    "export_map": ("topograph.exchange", "write"),
    "load_map": ("topograph.pipeline.face", "load_map"),
    "localize_bags": ("topograph.pipeline.face", "localize_bags"),
    "map_bags": ("topograph.pipeline.face", "map_bags"),
    "save_map": ("topograph.pipeline.face", "save_map"),
}

__all__ = [
    "Config",
    "Localizer",
    "Mapper",
    "TopoMap",
    "__version__",
    "export_map",
    "load_map",
    "localize_bags",
    "map_bags",
    "save_map",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'topograph' has no attribute {name!r}")
    from importlib import import_module

    module, word = _WHERE[name]
    return getattr(import_module(module), word)


def __dir__() -> list[str]:
    return sorted(__all__)
