"""Tree or not: a small network on the features of a candidate; its weights come from `tools/train_score.py`."""

from __future__ import annotations

import functools
import json
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.trunks.fit import FEATURES


@functools.lru_cache(maxsize=1)
def weights() -> tuple[Array, Array, list[NDArray[np.float32]]]:
    """Mean and deviation of the features, then weights and offsets of each layer in turn.

    Raises:
        ValueError: the file was trained for other features.
    """
    text = resources.files("topograph.trunks").joinpath("score.json").read_text()
    data = json.loads(text)
    if tuple(data["features"]) != FEATURES:
        raise ValueError("trunks/score.json was trained for other features: run tools/train_score.py")
    layers = [np.array(v, np.float32) for v in data["layers"]]
    return np.array(data["mean"]), np.array(data["deviation"]), layers


def score(features: Array) -> Array:
    """Log-odds (C,) that candidates with `features` (C, len(FEATURES)) are trees."""
    mean, deviation, layers = weights()
    x = (features - mean) / deviation
    return forward(np.minimum(np.maximum(x, -4.0), 4.0).astype(np.float32), layers)


def forward(x: NDArray[np.float32], layers: list[NDArray[np.float32]]) -> Array:
    """The network: layers of tanh, the last one linear."""
    for k in range(0, len(layers) - 2, 2):
        x = np.tanh(x @ layers[k] + layers[k + 1])
    return np.asarray(x @ layers[-2] + layers[-1], float)[:, 0]


@functools.lru_cache(maxsize=1)
def calibration() -> tuple[Array, Array]:
    """Factors (4,) on radial and tangential deviations by range class (0-5, 5-10, 10-20, 20+ m)."""
    data = json.loads(resources.files("topograph.trunks").joinpath("score.json").read_text())
    return np.array(data["radial_factor"], float), np.array(data["tangential_factor"], float)
