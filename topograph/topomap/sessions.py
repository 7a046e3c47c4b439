"""Whose sightings a map rests on: its sessions, and which tree was seen when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STANDING, MISSING = "standing", "missing"
MOST_PASSED = 6
"""Scans of a session that saw through a tree's place, or ought to have shown it, and none that saw it: it is missing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionRecord:
    """One run that a map was made of.

    Attributes:
        name: as `topograph.session.Session.id`.
        start_ns, end_ns: stamps of its first and last pose.
        distance: driven, m.
        inputs: names and hashes of its files, as JSON.
        verdict: of the audit.
    """

    name: str
    start_ns: int
    end_ns: int
    distance: float = 0.0
    inputs: str = "[]"
    verdict: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """R rows: a tree in a session.

    Attributes:
        tree, session: (R,) rows of the map's trees and sessions.
        count: (R,) sightings; `first_ns`, `last_ns` (R,) stamps of the first and the last one, 0 without any.
        passed: (R,) scans that saw through its place, or, where it was not seen, that should have shown it.
    """

    tree: NDArray[np.int64]
    session: NDArray[np.int64]
    count: NDArray[np.int64]
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]
    passed: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.tree)

    @staticmethod
    def none() -> Seen:
        """No rows."""
        n = np.zeros(0, np.int64)
        return Seen(tree=n, session=n, count=n, first_ns=n, last_ns=n, passed=n)

    def moved(self, tree_of: NDArray[np.int64], sessions: int) -> Seen:
        """The rows with trees renumbered, `tree_of` (T,), and `sessions` before theirs; trees that become -1 are left out."""
        tree = tree_of[self.tree]
        keep = tree >= 0
        rest = {k: getattr(self, k)[keep] for k in ("count", "first_ns", "last_ns", "passed")}
        return Seen(tree=tree[keep], session=self.session[keep] + sessions, **rest)

    def and_(self, other: Seen) -> Seen:
        """Both."""
        return Seen(**{k: np.concatenate([getattr(self, k), getattr(other, k)]) for k in self.__slots__})

    def states(self, trees: int) -> list[str]:
        """State of each of so many trees: what the last session that looked for it says."""
        out = [STANDING] * trees
        for i in np.argsort(self.session, kind="stable").tolist():
            if self.passed[i] >= max(MOST_PASSED, self.count[i]):  # a stray sighting does not raise a felled tree
                out[int(self.tree[i])] = MISSING
            elif self.count[i] > 0:
                out[int(self.tree[i])] = STANDING
        return out
