"""What counts as a trunk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from topograph.ranges import NonNegative, Positive, Real

LEAST_CLOUD = 8
"""Points of a trunk below which they show no side of it."""
MOST_CLOUD = 120
"""Points of one sight of a trunk that are kept: ten sights make a viewpoint, and a run holds hundreds of thousands."""


@dataclass(frozen=True, slots=True)
class TrunksConfig:
    """The front end; lengths in m.

    Attributes:
        front_end: "organised" (ours) or "thesis".
        nearest, farthest: distances between which trunks are looked for, m.
        low, high: heights above ground between which a trunk is traced, m.
        reference: height above ground at which the axis is stated, m.
        widest, thinnest: diameters of a trunk, m.
        prior_diameter, prior_sigma: of trunks too coarsely seen to measure.
        min_score: log-odds (tree or post) below which a candidate is dropped; what a scan doubts, many scans decide.
        score: file of another score, as tools/train_score.py writes it; "": the shipped one.
        recorded_sigma, recorded_growth, recorded_along: first guess of the noise of recorded detections: at the
            sensor, per metre of range, and along the axis (where on the trunk a detection lies is not stated, and
            in recordings it moves with the sensor's height: next to no information).
        recorded_reach: recorded detections beyond are left out.
    """

    front_end: Literal["organised", "thesis"] = "organised"
    nearest: Positive = 0.8
    farthest: Positive = 30.0
    low: Positive = 0.25
    high: Positive = 1.7
    reference: Positive = 0.8
    thinnest: Positive = 0.05
    widest: Positive = 1.3
    prior_diameter: Positive = 0.25
    prior_sigma: Positive = 0.09
    min_score: Real = -3.0
    score: str = ""
    recorded_sigma: Positive = 0.05
    recorded_growth: NonNegative = 0.01
    recorded_along: Positive = 5.0
    recorded_reach: Positive = 40.0
