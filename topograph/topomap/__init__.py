from dataclasses import dataclass
@dataclass(frozen=True, slots=True)
class TopomapConfig:
    """x"""
    x: int = 0
