"""Do the streams agree with each other and with the solve? Sound, doubtful because, refused because."""

from topograph.audit.checks import (
    REFUSING,
    fixes,
    headings,
    jumps,
    lean,
    offsets,
    refused_fixes,
    rows,
    seldom,
    standing,
    trunks,
    twice,
    unclaimed,
    unsure,
)
from topograph.audit.reckoned import way
from topograph.audit.seam import seam
from topograph.audit.verdict import Finding, Verdict

__all__ = [
    "REFUSING",
    "Finding",
    "Verdict",
    "fixes",
    "headings",
    "jumps",
    "lean",
    "offsets",
    "refused_fixes",
    "rows",
    "seam",
    "seldom",
    "standing",
    "trunks",
    "twice",
    "unclaimed",
    "unsure",
    "way",
]
