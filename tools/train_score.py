"""Trains the front end's score on randomised scenes (tools/scenes.py) and calibrates the stated deviations.

    python tools/train_score.py [--scenes 400] [--looks 6]

Seeds 0.. train, 100,000.. validate; nothing of them is reported anywhere else. Writes topograph/trunks/score.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import recordings
import scenes
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from topograph.geometry import Array
from topograph.simulate.growth import POST, TRUNK
from topograph.trees.existence import KIND_PRIOR
from topograph.trunks import fit as F
from topograph.trunks.config import TrunksConfig
from topograph.trunks.detector import candidates
from topograph.trunks.features import FEATURES, OVERHEAD
from topograph.trunks.score import CLIP, ERRORS, forward

HIDDEN = (64, 32)
SHIPPED = Path(__file__).parent.parent / "topograph" / "trunks" / "score.json"
RECORDED = 0.2
"""Weight of one recording against all scenes."""
RECORDED_AS = {
    "pine_plot": "real_stems/pine_plot",
    "lpine1": "real_stems/lpine1",
    "street": "street_avenue sweeps 0-149",
}
DROPPED = 0.3
"""Share of the training's candidates whose view above trunk height is taken away."""
PURE, IMPURE = 0.6, 0.15
"""Shares of a candidate's returns from one thing that make it that thing, or not that thing."""


def labelled(look: scenes.Look, config: TrunksConfig):
    """Features, class (0 tree, 1 post, 2 other, -1 unclear) and the rows of `errors` of one sweep's candidates.

    Errors: range, radial and tangential error (m) of the point against the trunk's axis at its height over the stated
    deviation, measured width less diameter, stems, most returns' material, diameter, what the lean adds (m); NaN where it is no tree.
    """
    c = candidates(look.scan, look.base_T_lidar, look.twist, config)
    n = len(c.fits)
    y, e = np.full(n, 2), np.full((n, 10), np.nan)
    if n == 0:
        return c.features, y, e
    _, source = cKDTree(look.base_xyz).query(c.points[c.label >= 0], distance_upper_bound=0.02)
    at = np.full(len(c.points), -1)
    at[np.flatnonzero(c.label >= 0)] = np.where(source < len(look.base_xyz), source, -1)
    run_of, chain_of = c.label, np.r_[c.chain, -1]
    chain = np.where(run_of >= 0, chain_of[np.maximum(run_of, -1)], -1)
    order = np.argsort(chain, kind="stable")
    for k in range(n):
        lo, hi = np.searchsorted(chain[order], [c.name[k], c.name[k] + 1])
        i = at[order[lo:hi]]
        i = i[i >= 0]
        m = look.swept.material[i]
        i, m = i[m >= 0], m[m >= 0]
        if len(m) < 2:
            y[k] = -1
            continue
        e[k, 7] = np.bincount(m).argmax()
        trunk, post = float(np.mean(m == TRUNK)), float(np.mean(m == POST))
        near = np.hypot(*(look.feet[:, :2] - c.fits[k, :2]).T) - 0.5 * look.orchard.diameters
        if trunk >= PURE:
            y[k] = 0
            j = int(np.bincount(look.swept.tree[i][m == TRUNK]).argmax())
            foot, axis = look.feet[j], look.axes[j]
            d = c.fits[k, :2] - foot[:2] - (c.fits[k, 2] - foot[2]) / axis[2] * axis[:2]
            line = c.fits[k, [F.LINE_X, F.LINE_Y]]
            if np.hypot(*d) > 0.4 + 0.5 * look.orchard.diameters[j]:
                y[k] = -1
            e[k, 9] = c.fits[k, F.LEVER] * c.fits[k, F.LEAN_SIGMA]
            e[k, 8] = look.orchard.diameters[j]
            e[k, :7] = [c.fits[k, F.FAR], d @ line, (line[0] * d[1] - line[1] * d[0]), c.fits[k, F.RADIAL],
                    c.fits[k, F.TANGENTIAL], c.fits[k, F.WIDE] - look.orchard.diameters[j], look.orchard.stems[j]]  # fmt: skip
        elif post >= PURE:
            y[k] = 1
        elif max(trunk, post) > IMPURE or near.min() < 0.3:
            y[k] = -1
    return c.features, y, e


def collect_one(seed: int, looks: int):
    """All candidates of one scene."""
    config = TrunksConfig()
    try:
        parts = [labelled(k, config) for k in scenes.looks(seed, looks)]
    except ValueError as err:  # a drawn design without room for a tree
        print(f"scene {seed}: {err}")
        return np.zeros((0, len(FEATURES))), np.zeros(0, int), np.zeros((0, 10))
    return tuple(np.concatenate(q) for q in zip(*parts, strict=True))


def collect(seeds: range, looks: int):
    """Features, classes and errors of many scenes, two at a time."""
    with ProcessPoolExecutor(2) as pool:
        parts = list(pool.map(partial(collect_one, looks=looks), seeds, chunksize=4))
    return tuple(np.concatenate([p[k] for p in parts]) for k in range(3))


def train(X: Array, y: Array, w: Array, epochs: int = 30, batch: int = 1024, rate: float = 3e-3) -> list[Array]:
    """Weights and offsets of the layers in turn, by Adam (Kingma & Ba 2015) on the weighted log loss; the rate falls as a
    cosine. X (N, F) is normalised, y (N,) the class, w (N,) the weight.
    """
    rng = np.random.default_rng(0)
    sizes = [X.shape[1], *HIDDEN, 3]
    q: list[Array] = []
    for a, b in pairwise(sizes):
        q += [rng.normal(0, 1 / np.sqrt(a), (a, b)).astype(np.float32), np.zeros(b, np.float32)]
    first, second = [np.zeros_like(v) for v in q], [np.zeros_like(v) for v in q]
    A, target = X.astype(np.float32), np.eye(3, dtype=np.float32)[y]
    weight = (w / w.mean()).astype(np.float32)[:, None]
    steps, k = epochs * (len(A) // batch), 0
    for epoch in range(epochs):
        order, loss = rng.permutation(len(A)), 0.0
        for i in range(0, len(A) - batch + 1, batch):
            rows = order[i : i + batch]
            h = [A[rows]]
            for j in range(0, len(q) - 2, 2):
                h.append(np.tanh(h[-1] @ q[j] + q[j + 1]))
            z = h[-1] @ q[-2] + q[-1]
            z = z - z.max(1, keepdims=True)
            log_p = z - np.log(np.exp(z).sum(1, keepdims=True))
            loss -= float(np.mean(weight[rows] * np.sum(target[rows] * log_p, 1, keepdims=True))) / (len(A) // batch)
            g = weight[rows] * (np.exp(log_p) - target[rows]) / batch
            gradient = [np.zeros(0)] * len(q)
            for j in range(len(q) - 2, -1, -2):
                gradient[j], gradient[j + 1] = h[j // 2].T @ g, g.sum(0)
                if j:
                    g = (g @ q[j].T) * (1 - h[j // 2] ** 2)
            k += 1
            now = 0.5 * rate * (1 + np.cos(np.pi * k / steps))
            for j in range(len(q)):
                first[j] = 0.9 * first[j] + 0.1 * gradient[j]
                second[j] = 0.999 * second[j] + 0.001 * gradient[j] ** 2
                step = (first[j] / (1 - 0.9**k)) / (np.sqrt(second[j] / (1 - 0.999**k)) + 1e-8)
                q[j] = q[j] - np.float32(now) * (step + 1e-4 * q[j]).astype(np.float32)
        if epoch % 10 == 9:
            print(f"epoch {epoch + 1}: loss {loss:.4f}", flush=True)
    return q


def error_model(X: Array, e: Array, which: int) -> Array:
    """Weights (1 + len(ERRORS),) of the log-linear model of one deviation, by maximum likelihood of Gaussian errors.

    X (N, F) normalised features of trunks with errors `e`; what the lean adds is in the stated part already.
    """
    columns = [FEATURES.index(k) for k in ERRORS]
    error, stated, lever = e[:, 1 + which], e[:, 3 + which], e[:, 9]
    A = np.concatenate([np.ones((len(X), 1)), X[:, columns]], axis=1)

    def cost(w: Array) -> tuple[float, Array]:
        scale = np.exp(np.clip(A @ w, -1.0, 2.5))
        var = (stated * scale) ** 2 + lever**2
        slope = (stated * scale) ** 2 / var * (1.0 - error**2 / var)
        return float(np.mean(0.5 * np.log(var) + 0.5 * error**2 / var)), A.T @ slope / len(A)

    return np.asarray(minimize(cost, np.r_[0.3, np.zeros(len(columns))], jac=True, method="L-BFGS-B").x)


def recorded(names: list[str], share: Array) -> tuple[Array, Array, Array]:
    """Features, classes and weights of candidates of recordings: each of them weighs a share of all that was simulated."""
    X, y, w = [np.zeros((0, len(FEATURES)))], [np.zeros(0, int)], [np.zeros(0)]
    for name in names:
        kept = Path("/tmp") / f"topograph_{name}.npz"
        if not kept.exists():
            if name == "street":
                parts = [recordings.street_candidates(0, 150, every) for every in (1, 2, 4)]
                found = tuple(np.concatenate([p[k] for p in parts]) for k in range(2))
            else:
                found = recordings.stem_candidates(name, 200, 7000)
            np.savez_compressed(kept, X=found[0], y=found[1])
        with np.load(kept) as f:
            sure = f["y"] >= 0
            X.append(f["X"][sure])
            y.append(f["y"][sure])
        w.append((RECORDED * share / np.maximum(np.bincount(y[-1], minlength=3), 1))[y[-1]])
        print(name, "candidates: tree, post, other:", np.bincount(y[-1], minlength=3))
    return np.concatenate(X), np.concatenate(y), np.concatenate(w)


def main() -> None:
    """Collect, train, calibrate, validate, write."""
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("--scenes", type=int, default=400)
    a.add_argument("--looks", type=int, default=6)
    a.add_argument("--cache", type=Path, help="keep what was collected here")
    a.add_argument(
        "--recorded", nargs="*", default=[], choices=["pine_plot", "lpine1", "street"], help="recordings to train on"
    )
    a.add_argument("--out", type=Path, default=SHIPPED)
    a = a.parse_args()
    if a.cache and a.cache.exists():
        with np.load(a.cache) as f:
            X, y, e, Xv, yv, ev = (f[k] for k in ("X", "y", "e", "Xv", "yv", "ev"))
    else:
        X, y, e = collect(range(a.scenes), a.looks)
        Xv, yv, ev = collect(range(100_000, 100_000 + max(a.scenes // 5, 1)), a.looks)
        if a.cache:
            np.savez_compressed(a.cache, X=X, y=y, e=e, Xv=Xv, yv=yv, ev=ev)
    print("candidates: tree, post, other, unclear:", [(y == k).sum() for k in (0, 1, 2, -1)])
    X, y, e = X[y >= 0], y[y >= 0], e[y >= 0]
    rng = np.random.default_rng(1)
    overhead = [FEATURES.index(k) for k in OVERHEAD]
    Z = X.copy()
    blind = rng.random(len(Z)) < DROPPED
    Z[np.ix_(blind, overhead)] = 0.0
    mean, deviation = Z.mean(0), Z.std(0) + 1e-6
    # What stands in a scene differs more between scenes than a prior could know; posts are fewer than trees.
    share = np.exp(KIND_PRIOR)
    weight = (share / np.bincount(y, minlength=3))[y]
    Zr, yr, wr = recorded(a.recorded, share)
    Zr[np.ix_(rng.random(len(Zr)) < DROPPED, overhead)] = 0.0
    every = np.clip((np.concatenate([Z, Zr]) - mean) / deviation, -CLIP, CLIP)
    layers = train(every, np.concatenate([y, yr]), np.concatenate([weight, wr]))
    N = np.clip((X - mean) / deviation, -CLIP, CLIP)
    one = (y == 0) & (e[:, 6] == 1) & (np.hypot(e[:, 1], e[:, 2]) < 0.25)  # stems of one tree have axes of their own
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    data = {
        "trained_by": f"tools/train_score.py --scenes {a.scenes} --looks {a.looks}, after commit {commit}",
        "training_seeds": [0, a.scenes - 1],
        "recordings": [RECORDED_AS[k] for k in a.recorded],
        "features": list(FEATURES),
        "mean": mean, "deviation": deviation, "low": np.minimum(Z.min(0), Zr.min(0, initial=1e9)), "high": np.maximum(Z.max(0), Zr.max(0, initial=-1e9)),
        "error_scale": np.stack([error_model(N[one], e[one], k) for k in (0, 1)]),
        "layers": layers,
    }  # fmt: skip
    text = {
        k: [np.round(q.astype(float), 4).tolist() for q in v] if k == "layers"
        else np.round(v, 5).tolist() if isinstance(v, np.ndarray) else v
        for k, v in data.items()
    }  # fmt: skip
    a.out.write_text(json.dumps(text) + "\n")
    print(np.round(data["error_scale"], 2))
    for low, high in ((0, 5), (5, 10), (10, 20), (20, 30)):
        here = one & (e[:, 0] >= low) & (e[:, 0] < high)
        scale = np.exp(
            np.clip(
                np.c_[np.ones(here.sum()), N[here][:, [FEATURES.index(k) for k in ERRORS]]] @ data["error_scale"].T,
                -1,
                2.5,
            )
        )
        z = e[here, 1:3] ** 2 / ((e[here, 3:5] * scale) ** 2 + e[here, 9:10] ** 2)
        print(
            f"{low}-{high} m: normalised squared error {z.sum(1).mean():.2f} of 2, median {np.median(z.sum(1)):.2f} of 1.39"
        )
    one &= X[:, 2] > np.log(6)
    A = np.stack([X[one, 3], X[one, 3] * 0 + 1, e[one, 0]], 1)
    print("width less diameter = a width + b + c range:", np.linalg.lstsq(A, e[one, 5], rcond=None)[0].round(4))
    Xv, yv = Xv[yv >= 0], yv[yv >= 0]
    for name, X_, y_ in (("train", X, y), ("validation", Xv, yv)):
        z = forward(np.clip((X_ - mean) / deviation, -CLIP, CLIP).astype(np.float32), layers)
        odds = z[:, 0] - np.logaddexp(z[:, 1], z[:, 2])
        p = odds > 0
        cells = []
        for lo, hi in ((0, 10), (10, 20), (20, 30)):
            here = (np.exp(X_[:, 0]) >= lo) & (np.exp(X_[:, 0]) < hi)
            t = y_[here] == 0
            cells.append(f"{lo}-{hi} m P {t[p[here]].mean():.3f} R {p[here][t].mean():.3f}")
        print(f"{name}: " + "; ".join(cells) + f"; kind right {np.mean(z.argmax(1) == y_):.3f}")
        for k, kind in enumerate(("tree", "post", "other")):
            print(
                "   ",
                kind,
                "called tree, post, other:",
                np.bincount(z[y_ == k].argmax(1), minlength=3) / max((y_ == k).sum(), 1),
            )


if __name__ == "__main__":
    main()
