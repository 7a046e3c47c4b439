"""Trains the front end's score on randomised scenes (tools/scenes.py) and calibrates the stated deviations.

    pip install -e '.[train]'
    python tools/train_score.py [--scenes 1800] [--looks 6] --recorded pine_plot lpine1 street

Seeds 0.. train, 100,000.. validate; nothing of them is reported anywhere else. Writes topograph/trunks/score.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import network
import numpy as np
import recordings
import scenes
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from topograph.geometry import Array
from topograph.simulate.growth import POST, TRUNK
from topograph.trunks import fit as F
from topograph.trunks.config import TrunksConfig
from topograph.trunks.detector import candidates
from topograph.trunks.features import FEATURES, OVERHEAD
from topograph.trunks.score import ERRORS, KIND_PRIOR, Layers, judge, log_softmax, normalised, tree_odds

SHIPPED = Path(__file__).parent.parent / "topograph" / "trunks" / "score.json"
RECORDED = {"pine_plot": 0.2, "lpine1": 0.2, "street": 0.04}
"""Weight of one recording against all scenes. The street's first half shows masts and walls and next to no tree: with more
weight it teaches that nothing in a street is one.
"""
RECORDED_AS = {
    "pine_plot": "real_stems/pine_plot",
    "lpine1": "real_stems/lpine1",
    "street": "street_avenue sweeps 0-149",
}
DROPPED = 0.3
"""Share of the training's candidates whose view above trunk height is taken away."""
PURE, PART, IMPURE = 0.6, 0.3, 0.15
"""Shares of a candidate's returns from one thing that make it that thing, that thing where it also stands at its place
(`AT`, m beside the surface), or not that thing."""
AT = 0.1


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
        rise = (c.fits[k, 2] - look.feet[:, 2]) / look.axes[:, 2]
        at_axis = look.feet[:, :2] + rise[:, None] * look.axes[:, :2]
        near = np.hypot(*(at_axis - c.fits[k, :2]).T) - 0.5 * look.orchard.diameters
        if trunk >= PURE or (trunk >= PART and near.min() < AT):
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
        elif max(trunk, post) > IMPURE or (trunk > 0.0 and near.min() < 2.0 * AT):
            y[k] = -1
    return c.features, y, e


def collect_one(seed: int, looks: int):
    """All candidates of one scene, and the sweep of each."""
    config = TrunksConfig()
    try:
        parts = [labelled(k, config) for k in scenes.looks(seed, looks)]
    except ValueError as err:  # a drawn design without room for a tree
        print(f"scene {seed}: {err}")
        return np.zeros((0, len(FEATURES)), np.float32), np.zeros(0, int), np.zeros((0, 10)), np.zeros(0, int)
    sweep = np.repeat(seed * looks + np.arange(len(parts)), [len(p[1]) for p in parts])
    X, y, e = (np.concatenate(q) for q in zip(*parts, strict=True))
    return X.astype(np.float32), y, e, sweep


def collect(seeds: range, looks: int):
    """Features, classes, errors and sweeps of many scenes, two at a time."""
    with ProcessPoolExecutor(2) as pool:
        parts = list(pool.map(partial(collect_one, looks=looks), seeds, chunksize=4))
    return tuple(np.concatenate([p[k] for p in parts]) for k in range(4))


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


def recorded(names: list[str], share: Array) -> tuple[Array, Array, Array, Array]:
    """Features, classes, weights and sweeps of candidates of recordings: each of them weighs a share of all that was simulated."""
    X, y, w, sweep = [np.zeros((0, len(FEATURES)))], [np.zeros(0, int)], [np.zeros(0)], [np.zeros(0, int)]
    for name in names:
        kept = Path("/tmp") / f"topograph_{name}.npz"
        if not kept.exists():
            if name == "street":
                parts = [recordings.street_candidates(0, 150, every) for every in (1, 2, 4)]
                found = tuple(
                    np.concatenate([p[k] + (k == 2) * 1000 * n for n, p in enumerate(parts)]) for k in range(3)
                )
            else:
                found = recordings.stem_candidates(name, 400, 7000)
            np.savez_compressed(kept, X=found[0], y=found[1], sweep=found[2])
        with np.load(kept) as f:
            X.append(f["X"])
            y.append(f["y"])
            sweep.append(f["sweep"] + RECORDED_FROM * (1 + len(sweep)))
        count = np.bincount(y[-1][y[-1] >= 0], minlength=3)
        w.append((RECORDED[name] * share / np.maximum(count, 1))[y[-1]])
        print(name, "candidates: tree, post, other:", count)
    return np.concatenate(X), np.concatenate(y), np.concatenate(w), np.concatenate(sweep)


RECORDED_FROM = 10_000_000
"""Sweeps of recordings are numbered from here on, those of simulated scenes below."""


def main() -> None:
    """Collect, train, calibrate, validate, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1800)
    parser.add_argument("--looks", type=int, default=6)
    parser.add_argument("--cache", type=Path, help="keep what was collected here")
    parser.add_argument(
        "--recorded", nargs="*", default=[], choices=["pine_plot", "lpine1", "street"], help="recordings to train on"
    )
    parser.add_argument("--out", type=Path, default=SHIPPED)
    a = parser.parse_args()
    if a.cache and a.cache.exists():
        with np.load(a.cache) as f:
            X, y, e, sweep, Xv, yv, ev, sweep_v = (f[k] for k in ("X", "y", "e", "sweep", "Xv", "yv", "ev", "sweep_v"))
    else:
        X, y, e, sweep = collect(range(a.scenes), a.looks)
        Xv, yv, ev, sweep_v = collect(range(100_000, 100_000 + max(a.scenes // 5, 1)), a.looks)
        if a.cache:
            np.savez(a.cache, X=X, y=y, e=e, sweep=sweep, Xv=Xv, yv=yv, ev=ev, sweep_v=sweep_v)
    print("candidates: tree, post, other, unclear:", [(y == k).sum() for k in (0, 1, 2, -1)])
    rng = np.random.default_rng(1)
    overhead = [FEATURES.index(k) for k in OVERHEAD]
    # What stands in a scene differs more between scenes than a prior could know; posts are fewer than trees.
    share = np.exp(KIND_PRIOR)
    weight = (share / np.bincount(y[y >= 0], minlength=3))[y]
    Zr, yr, wr, sweep_r = recorded(a.recorded, share)
    Z, every = np.concatenate([X, Zr]), np.concatenate([sweep, sweep_r])
    names, rows = np.unique(every, return_inverse=True)
    Z[np.ix_((rng.random(len(names)) < DROPPED)[rows], np.array(overhead))] = 0.0
    mean, deviation = Z[: len(X)].mean(0, dtype=float), Z[: len(X)].std(0, dtype=float) + 1e-6
    layers = network.train(normalised(Z, mean, deviation), np.r_[y, yr], np.r_[weight, wr], every)
    Xs, y_all = X, y
    X, y, e = X[y >= 0], y[y >= 0], e[y >= 0]
    N = normalised(X, mean, deviation)
    one = (y == 0) & (e[:, 6] == 1) & (np.hypot(e[:, 1], e[:, 2]) < 0.25)  # stems of one tree have axes of their own
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    data = {
        "trained_by": f"tools/train_score.py --scenes {a.scenes} --looks {a.looks}, after commit {commit}",
        "training_seeds": [0, a.scenes - 1],
        "recordings": [RECORDED_AS[k] for k in a.recorded],
        "features": list(FEATURES),
        "mean": mean, "deviation": deviation, "low": np.minimum(Z.min(0), Xs.min(0)), "high": np.maximum(Z.max(0), Xs.max(0)),
        "error_scale": np.stack([error_model(N[one], e[one], k) for k in (0, 1)]),
        **layers._asdict(),
    }  # fmt: skip
    text = {
        k: [np.round(q.astype(float), 4).tolist() for q in v] if k in Layers._fields
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
    for name, X_, y_, sweep_ in (("train", Xs, y_all, sweep), ("validation", Xv, yv, sweep_v)):
        order = np.argsort(sweep_, kind="stable")
        X_, y_ = X_[order], y_[order]
        parts = np.split(normalised(X_, mean, deviation), np.flatnonzero(np.diff(sweep_[order])) + 1)
        z = np.concatenate([judge(x, layers) for x in parts])[y_ >= 0]
        X_, y_ = X_[y_ >= 0], y_[y_ >= 0]
        p = tree_odds(log_softmax(z)) > 0
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
