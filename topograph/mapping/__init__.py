"""Associate <-> solve: a session in, its path and its trees out. Live and offline are two ways of calling it."""

from topograph.mapping.config import MappingConfig
from topograph.mapping.known import KnownMap, Placed
from topograph.mapping.mapper import Mapper
from topograph.mapping.progress import Progress, silent
from topograph.mapping.solve import Prepared, Solved, map_T_scans, prepare, solve_session

__all__ = [
    "KnownMap",
    "Mapper",
    "MappingConfig",
    "Placed",
    "Prepared",
    "Progress",
    "Solved",
    "map_T_scans",
    "prepare",
    "silent",
    "solve_session",
]
