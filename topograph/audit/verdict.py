"""What an audit says."""

from __future__ import annotations

from dataclasses import dataclass


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

    @property
    def reasons(self) -> tuple[str, ...]:
        """A sentence each."""
        return tuple(f.sentence for f in self.findings)
