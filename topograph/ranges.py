"""What a setting may be: types for the fields of the rooms' configurations, checked where a configuration is read."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Interval

_INF = float("inf")

Positive = Annotated[float, Interval(gt=0.0, lt=_INF)]
"""More than nothing: lengths, times, deviations that are divided by."""
NonNegative = Annotated[float, Interval(ge=0.0, lt=_INF)]
"""Nothing leaves it out."""
Chance = Annotated[float, Interval(gt=0.0, lt=1.0)]
"""A chance that is neither ruled out nor certain."""
Share = Annotated[float, Interval(ge=0.0, le=1.0)]
"""A part of a whole."""
Real = Annotated[float, Interval(gt=-_INF, lt=_INF)]
"""Any number."""
Count = Annotated[int, Ge(1)]
"""At least one."""
