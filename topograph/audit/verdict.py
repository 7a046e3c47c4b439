"""What an audit says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One check that did not pass: `value` beyond `bound` (in `unit`), a sentence that says when and what to do."""

    name: str
    value: float
    bound: float
    unit: str
    sentence: str
    refuses: bool = False


@dataclass(frozen=True, slots=True)
class Verdict:
    """All findings of a run, the gravest first; none: the run is sound."""

    findings: tuple[Finding, ...] = ()

    @property
    def word(self) -> str:
        """ "sound", "doubtful" or "refused"."""
        if any(f.refuses for f in self.findings):
            return "refused"
        return "doubtful" if self.findings else "sound"

    def accepting(self, names: Sequence[str]) -> Verdict:
        """The same, where findings named so do not refuse."""
        return Verdict(tuple(replace(f, refuses=f.refuses and f.name not in names) for f in self.findings))

    def record(self) -> dict[str, object]:
        """As report.json holds it."""
        rows = [
            {
                "name": f.name,
                "value": f.value,
                "bound": f.bound,
                "unit": f.unit,
                "refuses": f.refuses,
                "sentence": f.sentence,
            }
            for f in self.findings
        ]
        return {"word": self.word, "findings": rows}

    @property
    def reasons(self) -> tuple[str, ...]:
        """A sentence each."""
        return tuple(f.sentence for f in self.findings)
