"""`report.html`: one file, no network, opens anywhere; what became of the run first, then figures, pictures and what was left out."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from topograph.audit import Finding
from topograph.evaluate import Metric
from topograph.report.templates import render
from topograph.whole import write_text

ABOUT = {
    "Map": "Ellipses: 95 %, ten times enlarged.",
    "Residuals by factor": "In standard deviations that were stated (after noise scales were learnt); the line is the Gaussian that they should follow. What is beyond 5 is counted at 5. "
    "IMU factors are not among them.",
    "Residuals over time": "Their size in each part of the run: the middle and the 95th percentile, and where a Gaussian has them (dashed). A part that "
    "stands out is where to look: a slip, a bad fix, a clock that stepped.",
    "Errors of the trees": "Against the truth that was given, horizontally, at the foot.",
    "Localization": "Hollow circle: the first pose. Places left: how many places on the map still fit.",
    "Errors": "Against the truth that was given.",
}
"""Caption -> what a picture shows."""
MEANING = {
    "doubles": "share of the trees that have another one much nearer than is usual: a loop that was not closed",
    "loops closed": "times that old ground was recognised without GNSS",
    "keyframes": "poses that are variables of the graph",
    "tree NEES (2 dof)": "squared error over stated covariance; 2 is right, more is too sure",
    "NEES of x and y (2 is right)": "squared error over stated covariance; more is too sure",
    "trunk residual median": "how far sightings lie from where their tree is",
    "largest stated deviation (1 σ)": "relative to the map",
}
"""Figure -> what it is, where its name does not say."""
TONES = {"no trees": "bad", "sound": "good", "found": "good", "doubtful": "fair", "refused": "bad", "unknown": "bad"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """What a report page says.

    Attributes:
        word: sound, doubtful, refused, no trees; found, unknown. `sentence` goes on from it; `tone` is good, fair or bad, by default the word's.
        findings: why, where it is not sound.
        figures: caption -> PNG; `skipped`: reason -> count.
        notes: what was assumed or mended.
        walk: file beside the page with the same to walk through, and what it is called; `files` are further ones beside it.
    """

    title: str
    word: str
    sentence: str = ""
    tone: str = ""
    findings: Sequence[Finding] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    metrics: Sequence[Metric] = ()
    figures: Mapping[str, bytes] = field(default_factory=dict)
    notes: Sequence[str] = ()
    skipped: Mapping[str, int] = field(default_factory=dict)
    walk: tuple[str, str] | None = None
    files: Sequence[str] = ()

    def html(self) -> str:
        """The page as text."""
        reasons = [
            {"sentence": f.sentence, "bound": f"{f.name} {f.value:.3g} {f.unit}".strip() + f", bound {f.bound:.3g}"}
            for f in self.findings
        ]
        return render(
            "report.html", title=self.title, word=self.word, sentence=self.sentence, tone=self.tone or TONES.get(self.word, "fair"), reasons=reasons,
            facts=self.facts, notes=self.notes, skipped=sorted(self.skipped.items()),
            metrics=[{"name": m.name, "value": show(m), "better": m.better, "about": MEANING.get(m.name, "")} for m in self.metrics],
            files=self.files,
            walk=None if self.walk is None else {"href": self.walk[0], "text": self.walk[1]},
            figures=[
                {"caption": k, "about": ABOUT.get(k, ""), "data": base64.b64encode(png).decode()} for k, png in self.figures.items()
            ],
        )  # fmt: skip

    def write(self, path: Path) -> None:
        """Write it, whole or not at all."""
        write_text(path, self.html())


def show(m: Metric) -> str:
    """A metric's value for people: centimetres where metres would be all zeros."""
    v = m.value
    if not np.isfinite(v):
        return "–"
    if m.unit == "m":
        return f"{100 * v:.1f} cm" if abs(v) < 1 else f"{v:.2f} m"
    if m.unit == "rad":
        return f"{np.degrees(v):.2f}°"
    if isinstance(v, int) or (float(v).is_integer() and abs(v) >= 2):
        return f"{int(v)} {m.unit}".strip()
    return f"{v:.3f} {m.unit}".strip()
