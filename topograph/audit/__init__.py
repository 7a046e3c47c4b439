"""Do the streams agree with each other and with the solve? Sound, doubtful because, refused because."""

from topograph.audit.verdict import Finding, Verdict

__all__ = ["Finding", "Verdict"]
