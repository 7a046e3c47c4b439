"""How long work says how far it is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Told a stage and the share of it that is done."""


def silent(stage: str, share: float) -> None:
    """No progress shown."""
