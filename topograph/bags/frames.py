"""The tree of sensor frames, from TF and configuration."""

from __future__ import annotations

import numpy as np

from topograph.errors import FrameError
from topograph.geometry import Array, from_xyz_rpy, inverse


class Frames:
    """Static transforms between frames; `find` walks the tree in both directions."""

    def __init__(self, base: str, extrinsics: dict[str, tuple[float, float, float, float, float, float]]) -> None:
        self.base = base
        self._edges: dict[str, dict[str, Array]] = {}
        self._given = {k.lstrip("/"): from_xyz_rpy(*v) for k, v in extrinsics.items()}

    def add(self, parent: str, child: str, parent_T_child: Array) -> None:
        """One edge of the tree; a later message for the same edge wins."""
        a, b = parent.lstrip("/"), child.lstrip("/")
        self._edges.setdefault(a, {})[b] = parent_T_child
        self._edges.setdefault(b, {})[a] = inverse(parent_T_child)

    def __len__(self) -> int:
        return len(self._edges)

    def find(self, frame: str) -> Array | None:
        """`base_T_frame` (4, 4), or None when no chain leads there."""
        frame = frame.lstrip("/")
        if frame in self._given:
            return self._given[frame]
        if frame == self.base or not frame:
            return np.eye(4)
        seen = {self.base}
        queue: list[tuple[str, Array]] = [(self.base, np.eye(4))]
        while queue:
            here, base_T_here = queue.pop(0)
            for there, here_T_there in self._edges.get(here, {}).items():
                if there in seen:
                    continue
                base_T_there = base_T_here @ here_T_there
                if there == frame:
                    return base_T_there
                seen.add(there)
                queue.append((there, base_T_there))
        return None

    def of(self, kind: str, frame: str) -> Array | None:
        """`base_T_frame` (4, 4) of the sensor of a stream; None where nobody tells: its frame has no name or no way to the base.

        An extrinsic may be given by the stream's kind too ("fix", "imu", "heading").
        """
        if kind in self._given:
            return self._given[kind]
        return self.find(frame) if frame else None

    def get(self, frame: str) -> Array:
        """`base_T_frame` (4, 4).

        Raises:
            FrameError: no chain of transforms leads from the base to `frame`.
        """
        found = self.find(frame)
        if found is None:
            known = ", ".join(sorted(self._edges)) or "none (the bag has no /tf_static)"
            raise FrameError(
                f"no transform from {self.base!r} to {frame!r} (frames known: {known}): "
                f"add --extrinsic {frame}=X,Y,Z,ROLL,PITCH,YAW (metres, radians) or choose --base-frame"
            )
        return found

    def all(self) -> dict[str, Array]:
        """`base_T_frame` (4, 4) of all frames with a way to the base."""
        found = {f: self.find(f) for f in sorted({*self._edges, *self._given})}
        return {f: T for f, T in found.items() if T is not None}

    def names(self) -> list[str]:
        """All frames with a way to the base."""
        return list(self.all())
