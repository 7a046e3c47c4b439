"""Do the streams agree with each other and with the solve? Sound, doubtful because, refused because."""

from topograph.audit.checks import (
    REFUSING,
    fixes,
    headings,
    jumps,
    lean,
    offsets,
    rows,
    seldom,
    standing,
    trunks,
    twice,
    unclaimed,
    unsure,
)
from topograph.audit.verdict import Finding, Verdict
from topograph.audit.way import way

__all__ = [
    "REFUSING",
    "Finding",
    "Verdict",
    "fixes",
    "headings",
    "jumps",
    "lean",
    "offsets",
    "rows",
    "seldom",
    "standing",
    "trunks",
    "twice",
    "unclaimed",
    "unsure",
    "way",
]
