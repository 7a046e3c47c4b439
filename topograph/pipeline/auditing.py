"""The audit of a solved run."""

from __future__ import annotations

from topograph.audit import Verdict
from topograph.pipeline.mapping import Solved


def audited(solved: Solved) -> Verdict:
    """Whether to believe it."""
    return Verdict()
