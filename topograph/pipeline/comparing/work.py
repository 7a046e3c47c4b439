"""What is compared, and what all tables share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from topograph.errors import InsufficientDataError, TopographError
from topograph.evaluate import Metric, Truth, WorldInMap, map_metrics, path_metrics, world_in_map
from topograph.evaluate.chapter5 import node_metrics
from topograph.evaluate.comparison import Comparison, Row
from topograph.pipeline.read import Heard
from topograph.topomap import TopoMap


@dataclass(slots=True)
class Work:
    """What is compared, and what it is made of: truths of the runs, what each front end made of them, truth to map, full chains."""

    out: Comparison
    truths: list[Truth | None]
    by_fixes: bool = False
    heard: dict[tuple[str, str], Heard] = field(default_factory=dict)
    worlds: dict[str, WorldInMap] = field(default_factory=dict)

    @property
    def one_front_end(self) -> bool:
        """The runs hold trunk detections, no clouds: there is nothing that the thesis's front end could see."""
        return all("points" not in self.heard["organised", r].session.chosen for r in self.out.runs)

    @property
    def first(self) -> str:
        return self.out.runs[0]


def add_map(w: Work, table: str, name: str, topo: TopoMap, truth: Truth | None, path: Any) -> None:
    """A row of a table of maps; `path`: stamps and poses that the map was made with."""
    metrics = [Metric("nodes", len(topo.trees()))]
    if truth is not None and len(truth.trees):
        try:
            metrics = node_metrics(topo, truth)
            metrics += [m for m in map_metrics(topo, truth) if "NEES" in m.name]
        except TopographError as err:
            w.out.notes.append(f"{name}: {err}")
    if truth is not None and len(truth.stamps_ns) and not w.by_fixes:  # the thesis's path is that very filter's
        stamps, poses = path
        metrics += path_metrics(stamps, poses, topo.datum, truth.stamps_ns, truth.world_T_robot, truth.datum)
    w.out.rows.append(Row(table, name, w.first, metrics))


def world_or_note(w: Work, map_name: str, truth: Truth) -> WorldInMap | None:
    """`world_of`, or a note why there is none."""
    try:
        return world_of(w, map_name, truth)
    except TopographError as err:
        w.out.notes.append(f"{map_name}: {err}")
        return None


def world_of(w: Work, map_name: str, truth: Truth) -> WorldInMap:
    """Georeferenced truths find into a georeferenced map by themselves; else the frame is that of the run that was mapped."""
    if truth.datum is None or w.out.maps[map_name].datum is None:
        if map_name in w.worlds:
            return w.worlds[map_name]
        if truth is not w.truths[0] and not len(truth.trees):
            raise InsufficientDataError(
                "the map is local and the run that it was made of has no truth: nothing leads from the truth into it"
            )
    return world_in_map(w.out.maps[map_name], truth)
