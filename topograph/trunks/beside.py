"""The loops around the score's layers: features in, and what a candidate is judged beside."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def prepared(features, mean, deviation, low, high, clip):
    """Features (C, F) in deviations from the training's mean, clipped, as float32; and which rows (C,) leave the training's range or are
    not finite. What is not finite is as the mean: one must not speak for the others.
    """
    n, m = features.shape
    x, far = np.empty((n, m), np.float32), np.zeros(n, np.bool_)
    for i in range(n):
        inside = True
        for k in range(m):
            v = features[i, k]
            inside &= (v >= low[k]) & (v <= high[k])  # NaN is not
            t = (v - mean[k]) / deviation[k]
            x[i, k] = min(max(t, -clip), clip) if t == t else 0.0
        far[i] = not inside
    return x, far


@njit(cache=True, error_model="numpy")
def judged_beside(h, z, alone, least):
    """What the second judgement sees (C, 2 H + 5): a candidate's description `h` (C, H), the log-probabilities of its first scores
    `z` (C, 3), how many trees and posts its sweep has besides, and the mean description of those trees.
    """
    n, m = h.shape
    out = np.empty((n, 2 * m + 5), np.float32)
    p, log_p = np.empty((n, 3)), np.empty((n, 3))
    trees, posts = 0.0, 0.0
    total = np.zeros(m)
    for i in range(n):
        top = max(z[i, 0], z[i, 1], z[i, 2])
        sum_ = np.exp(z[i, 0] - top) + np.exp(z[i, 1] - top) + np.exp(z[i, 2] - top)
        for k in range(3):
            log_p[i, k] = z[i, k] - top - np.log(sum_)
            p[i, k] = np.exp(log_p[i, k])
        trees += p[i, 0]
        posts += p[i, 1]
        for k in range(m):
            total[k] += p[i, 0] * h[i, k]
    for i in range(n):
        other_trees, other_posts = max(trees - p[i, 0], 0.0), max(posts - p[i, 1], 0.0)
        for k in range(m):
            out[i, k] = h[i, k]
            out[i, m + 5 + k] = (total[k] - p[i, 0] * h[i, k]) / (other_trees + alone)
        for k in range(3):
            out[i, m + k] = max(log_p[i, k], -least)
        out[i, m + 3], out[i, m + 4] = np.log1p(other_trees), np.log1p(other_posts)
    return out
