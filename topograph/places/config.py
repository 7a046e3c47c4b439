"""Settings of the place search."""

from __future__ import annotations

from dataclasses import dataclass

from topograph.ranges import Chance, Count, NonNegative, Positive


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacesConfig:
    """What the search believes of landmarks and trees. Lengths in m; for what localization sets, see `LocalizeConfig`.

    Attributes:
        map_sigma: standard deviation of a mapped tree per axis beyond what its covariance says.
        anchors: chance of missing the right place that the choice of anchor pairs leaves.
        bound: nats below the best at which a placement is dropped.
        modes: placements that are weighed with their full covariance.
        felled: share of the mapped trees that are gone or never seen.
        scales, scale_prior: noise scales that are marginalised and their prior.
    """

    map_sigma: NonNegative
    anchors: Chance
    bound: Positive
    modes: Count
    felled: Chance
    scales: tuple[Positive, ...]
    scale_prior: tuple[Positive, ...]
