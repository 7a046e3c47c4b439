"""Associate <-> solve: a session in, its path and its trees out. Live and offline are two ways of calling it."""

from topograph.mapping.config import MappingConfig
from topograph.mapping.known import KnownMap, Placed
from topograph.mapping.mapper import Mapper
from topograph.mapping.progress import Progress, silent
from topograph.mapping.solve import Solved, map_T_scans, solve_session

__all__ = [
    "KnownMap",
    "Mapper",
    "MappingConfig",
    "Placed",
    "Progress",
    "Solved",
    "map_T_scans",
    "silent",
    "solve_session",
]
