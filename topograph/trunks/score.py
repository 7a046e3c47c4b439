"""Tree or not: a small network on the features of a candidate; its weights come from `tools/train_score.py`."""

from __future__ import annotations

import functools
import json
from importlib import resources

import numpy as np

from topograph.geometry import Array
from topograph.trunks.fit import FEATURES


@functools.lru_cache(maxsize=1)
def weights() -> tuple[Array, ...]:
    """Mean and deviation of the features, then weights and offsets of the two layers.

    Raises:
        ValueError: the file was trained for other features.
    """
    text = resources.files("topograph.trunks").joinpath("score.json").read_text()
    data = json.loads(text)
    if tuple(data["features"]) != FEATURES:
        raise ValueError("trunks/score.json was trained for other features: run tools/train_score.py")
    return tuple(np.array(data[k], float) for k in ("mean", "deviation", "w1", "b1", "w2", "b2"))


def score(features: Array) -> Array:
    """Log-odds (C,) that candidates with `features` (C, len(FEATURES)) are trees."""
    mean, deviation, w1, b1, w2, b2 = weights()
    x = np.clip((features - mean) / deviation, -4.0, 4.0)
    return np.asarray(np.tanh(x @ w1 + b1) @ w2 + b2)[:, 0]


@functools.lru_cache(maxsize=1)
def calibration() -> tuple[Array, Array]:
    """Factors (4,) on radial and tangential deviations by range class (0-5, 5-10, 10-20, 20+ m)."""
    data = json.loads(resources.files("topograph.trunks").joinpath("score.json").read_text())
    return np.array(data["radial_factor"], float), np.array(data["tangential_factor"], float)
