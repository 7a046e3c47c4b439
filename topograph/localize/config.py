"""Settings of localization."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from topograph.places import PlacesConfig
from topograph.ranges import Chance, Count, NonNegative, Positive, Share


@dataclass(frozen=True, slots=True)
class LocalizeConfig:
    """What the localizer believes of detections, map and motion. Lengths in m, angles in rad.

    Attributes:
        risk: it commits when all rivals together are less probable than this.
        view: farthest trunk that is used.
        seen: chance that a trunk in view is detected in one scan; held against what the run shows.
        clutter: share of detections that are no lasting object.
        new, felled: share of trees that are not in the map; of mapped trees that are gone or never seen.
        map_unknown: standard deviation of a tree whose covariance the map does not state, m (the thesis's maps).
        map_sigma: least standard deviation of a mapped tree per axis: what its covariance does not know.
        trunk_sigma: added to every detection's deviation: the centre depends on the side that is seen.
        diameter_sigma: least deviation between a diameter as mapped and as measured.
        scales, scale_prior: noise scales that are marginalised and their prior.
        unknown: prior of being somewhere that is not on the map, among trees at random.
        alike: prior of being in another orchard of the same design. Small: it is the guard against a placement that fits
            better than all others and still not well.
        gate: chi-square (2 dof) of a match.
        pair: longest pair of trees in the index.
        anchors: chance of missing the right place that the choice of anchor pairs leaves.
        bound: nats below the best at which an alignment is dropped.
        modes: alignments that are evaluated with their full covariance.
        information: share of ln(4 N / risk) that a submap must hold before it is searched.
        again: distance between two full searches of large maps.
        landmarks: most landmarks of a submap that are searched with.
        forget: distance after which an unseen landmark is dropped.
        lost, slip: thresholds of the two cumulative sums (nats).
        shadow: distance after which the shadow's submap begins anew.
        degraded: standard deviation of the position above which tracking is called degraded.
        along, across, step, yaw_gyro, yaw_rate, yaw_wheels, yaw_distance: noise of dead reckoning; shares of the distance
            and of the turn, m a step, rad/√s with a gyro, rad/√m without.
        estimator: what estimates the pose while tracking: "graph", a fixed-lag smoother (localize/hypothesis.py), or "filter", the
            one that associates.
        measure: what of a trunk the graph takes: "both", "ranges" (as the thesis does) or "bearings".
        planar_tilt: deviation of roll and pitch where no IMU holds them.
    """

    risk: Chance = 1e-4
    view: Positive = 25.0
    seen: Chance = 0.8
    clutter: Share = 0.1
    new: Chance = 0.04
    felled: Chance = 0.04
    map_unknown: Positive = 0.15
    map_sigma: Positive = 0.03
    trunk_sigma: NonNegative = 0.015
    diameter_sigma: Positive = 0.03
    scales: tuple[Positive, ...] = (1.0, 1.5, 2.2)
    scale_prior: tuple[Positive, ...] = (0.9, 0.07, 0.03)
    unknown: Chance = 0.02
    alike: Chance = 1e-4
    gate: Positive = 13.8
    pair: Positive = 16.0
    anchors: Chance = 1e-3
    bound: Positive = 25.0
    modes: Count = 300
    information: Positive = 0.35
    again: Positive = 2.0
    landmarks: Count = 40
    forget: Positive = 40.0
    lost: Positive = 12.0
    slip: Positive = 12.0
    shadow: Positive = 5.0
    degraded: Positive = 0.3
    along: Positive = 0.03
    across: Positive = 0.02
    step: Positive = 0.004
    yaw_gyro: Positive = 0.004
    yaw_rate: Positive = 5e-4
    yaw_wheels: Positive = 0.08
    yaw_distance: Positive = 0.01
    planar_tilt: Positive = 0.06
    estimator: Literal["graph", "filter"] = "graph"
    measure: Literal["both", "ranges", "bearings"] = "both"

    @property
    def places(self) -> PlacesConfig:
        """What the place search is told."""
        return PlacesConfig(
            map_sigma=self.map_sigma, anchors=self.anchors, bound=self.bound, modes=self.modes, felled=self.felled,
            scales=self.scales, scale_prior=self.scale_prior,
        )  # fmt: skip
