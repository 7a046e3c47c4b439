"""Tree, post or something else: a small network on the features of a candidate; its weights come from `tools/train_score.py`."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from topograph.errors import InputError
from topograph.geometry import Array
from topograph.trunks.beside import judged_beside, prepared
from topograph.trunks.features import FEATURES

KINDS = ("tree", "post", "other")
"""What a candidate can be, in the order of the columns of log-probabilities."""
TREE, POST, OTHER = range(3)
KIND_PRIOR = np.log(np.array([0.2, 0.06, 0.74]))
"""Shares of the kinds that the score is trained with."""
CLIP = 4.0
"""Features further than this from the training's mean, in its deviations, tell no more than that they are far."""
ALONE = 1.0
"""Trees' worth of the training's mean that is mixed to the mean of a sweep's trees: few trees tell little."""
LEAST = 8.0
"""Log-probabilities below minus this are all the same."""
TEMPER = 0.5
"""Share of the evidence that is left to a candidate outside of what was trained on."""


class Layers(NamedTuple):
    """Weights and offsets in turn.

    Attributes:
        describe: of the layers that describe a candidate by itself.
        alone: of the one that judges it by that.
        beside: of those that judge it beside the trees of its sweep.
    """

    describe: list[NDArray[np.float32]]
    alone: list[NDArray[np.float32]]
    beside: list[NDArray[np.float32]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """The trained score.

    Attributes:
        mean, deviation: (F,) of the features in training; `low`, `high` (F,) their range there.
        error_scale: (2, 1 + len(ERRORS)) weights of the model of radial and tangential deviations.
        layers: see `judge`.
    """

    mean: Array
    deviation: Array
    low: Array
    high: Array
    error_scale: Array
    layers: Layers


@functools.lru_cache(maxsize=4)
def network(file: str = "") -> Network:
    """The weights of a `score` file; "": the shipped one.

    Raises:
        InputError: the file cannot be read, or was trained for other features.
    """
    try:
        at = resources.files("topograph.trunks").joinpath("score.json") if file == "" else Path(file)
        data = json.loads(at.read_text())
        if tuple(data["features"]) != FEATURES:
            raise InputError(f"{file or 'trunks/score.json'} was trained for other features: run tools/train_score.py")
        row = {k: np.array(data[k], float) for k in ("mean", "deviation", "low", "high", "error_scale")}
        layers = Layers(**{k: [np.array(v, np.float32) for v in data[k]] for k in Layers._fields})
        return Network(layers=layers, **row)
    except (OSError, ValueError, KeyError, TypeError) as err:
        raise InputError(f"{file}: not a score file ({err}); tools/train_score.py writes them") from err


def kinds(features: Array, n: Network) -> Array:
    """Log-probabilities (C, 3) of KINDS of candidates of one sweep with `features` (C, len(FEATURES))."""
    x, far = prepared(features, n.mean, n.deviation, n.low, n.high, CLIP)
    log_p = log_softmax(judge(x, n.layers))
    # Outside of what was trained on nobody knows: the answer is drawn towards the prior, and many sightings decide.
    log_p[far] = log_softmax(KIND_PRIOR + TEMPER * (log_p[far] - KIND_PRIOR))
    return log_p


def normalised(features: Array, mean: Array, deviation: Array) -> NDArray[np.float32]:
    """Features (C, F) in deviations from the training's mean, clipped."""
    return np.asarray(np.clip((features - mean) / deviation, -CLIP, CLIP).astype(np.float32))


def judge(x: NDArray[np.float32], layers: Layers) -> Array:
    """Scores (C, 3) of KINDS of the candidates of one sweep with normalised features `x` (C, F).

    Each is judged alone first, then beside the mean of what was taken for the sweep's other trees, how many they are, and
    how many posts: where trees have crowns, a thin thing without one is a post (a network on sets, Zaheer et al. 2017).
    """
    h = np.maximum(_forward(x, layers.describe), 0.0)
    z = _forward(h, layers.alone)
    seen = judged_beside(h, z, ALONE, LEAST)
    return np.asarray(z + _forward(seen, layers.beside), float)


def _forward(x: NDArray[np.float32], layers: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Linear layers with rectifiers between them."""
    for k in range(0, len(layers) - 2, 2):
        x = np.maximum(x @ layers[k] + layers[k + 1], 0.0)
    return np.asarray(x @ layers[-2] + layers[-1])


def log_softmax(z: NDArray[Any]) -> NDArray[Any]:
    """Logarithms (C, 3) of probabilities from scores (C, 3)."""
    top = z.max(axis=1, keepdims=True)
    return np.asarray(z - top - np.log(np.exp(z - top).sum(axis=1, keepdims=True)))


def tree_odds(log_p: Array) -> Array:
    """Log-odds (C,) of tree against all else."""
    return np.asarray(log_p[:, TREE] - np.logaddexp(log_p[:, POST], log_p[:, OTHER]))


def column_odds(log_p: Array) -> Array:
    """Log-odds (C,) of tree or post, things that stand still and mark a place, against all else."""
    return np.asarray(np.logaddexp(log_p[:, TREE], log_p[:, POST]) - log_p[:, OTHER])


ERRORS = ("range", "points", "width_spread", "line_rms", "rough", "free", "undergrowth", "close_by")
"""Features that say how far a fit is to be trusted: what is half hidden, or not one column, is farther off."""


def error_scales(features: Array, n: Network) -> Array:
    """Factors (C, 2) on the radial and tangential deviations of fits with `features`, learned from their errors: a
    log-linear model of the deviation.
    """
    columns = [FEATURES.index(k) for k in ERRORS]
    x = np.clip((features[:, columns] - n.mean[columns]) / n.deviation[columns], -CLIP, CLIP)
    return np.asarray(np.exp(np.clip(x @ n.error_scale[:, 1:].T + n.error_scale[:, 0], -1.0, 2.5)))
