"""Trains the score of the trunk front end, and the factors of its covariances, on simulated bags.

    python tools/train_score.py TRAIN_DIR VALIDATION_DIR

Both folders hold bags of `topograph simulate` with their truth. Orchards of the validation folder are of a design
that the training folder does not have. Weights go to topograph/trunks/score.json. Seeds: the bags' own; 0 for the
initial weights and the shuffle.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from topograph.bags import Recording, Scan
from topograph.evaluate.truth import Truth
from topograph.geometry import interpolate, inverse, transform
from topograph.motion import StreamsBuilder, twist_during
from topograph.trunks.config import TrunksConfig
from topograph.trunks.detector import RANGE_EDGES, candidates
from topograph.trunks.fit import FEATURES

HIDDEN = 24


def collect(folder: Path, every: int):
    """Features (N, F), labels (N,), fits (N, 16), axis errors (N, 2) radial and tangential, of all candidates."""
    X, y, fits, errors = [], [], [], []
    for bag in sorted(folder.glob("*.bag")):
        truth = Truth.load(bag.with_name(bag.stem + ".truth"))
        with Recording([bag]) as r:
            builder, pending, n = StreamsBuilder(), [], 0
            imu = r.frames.get("imu_link")[:3, :3]
            lidar = r.frames.get("velodyne")
            for _, m in r.messages():
                if not isinstance(m, Scan):
                    builder.add(m)
                    continue
                pending.append(m)
                if len(pending) < 2:
                    continue
                scan = pending.pop(0)
                n += 1
                if n % every:
                    continue
                twist, _ = twist_during(scan.stamp_ns - 100_000_000, scan.stamp_ns, builder.odometry, builder.imu, imu)
                c = candidates(scan, lidar, twist, TrunksConfig())
                if not len(c.fits):
                    continue
                T = interpolate(truth.stamps_ns, truth.world_T_robot, scan.stamp_ns)[0]
                foot, axis = transform(inverse(T), truth.trees), truth.axes @ T[:3, :3]
                # The true axis at the height where the fit states its point.
                t = (c.fits[:, None, 2] - foot[None, :, 2]) / axis[None, :, 2]
                at = foot[None, :, :2] + t[..., None] * axis[None, :, :2]
                d = c.fits[:, None, :2] - at
                distance = np.linalg.norm(d, axis=2)
                j = distance.argmin(axis=1)
                k = np.arange(len(j))
                near = distance[k, j]
                many = truth.stems[j] > 1
                label = np.where(near < np.where(many, 0.35, 0.15), 1.0, np.where(near < 0.45, np.nan, 0.0))
                e = d[k, j]
                line = c.fits[:, 14:16]
                radial = np.sum(e * line, axis=1)
                tangential = e[:, 1] * line[:, 0] - e[:, 0] * line[:, 1]
                errors.append(np.stack([radial, tangential, truth.stems[j], c.fits[:, 6] - truth.diameters[j]], axis=1))
                X.append(c.features)
                y.append(label)
                fits.append(c.fits)
        print(bag.name, sum(map(len, y)), flush=True)
    return np.concatenate(X), np.concatenate(y), np.concatenate(fits), np.concatenate(errors)


def unpack(w, f):
    a = f * HIDDEN
    return w[:a].reshape(f, HIDDEN), w[a : a + HIDDEN], w[a + HIDDEN : a + 2 * HIDDEN, None], w[-1:]


def train(X, y, ridge=2e-4):
    """Weights of the two layers, by L-BFGS on the log loss."""
    f = X.shape[1]
    rng = np.random.default_rng(0)
    w0 = rng.normal(0, 0.2, f * HIDDEN + 2 * HIDDEN + 1)

    def loss(w):
        w1, b1, w2, b2 = unpack(w, f)
        h = np.tanh(X @ w1 + b1)
        z = (h @ w2 + b2)[:, 0]
        value = np.mean(np.logaddexp(0, z) - y * z) + ridge * (w @ w)
        g = (1 / (1 + np.exp(-z)) - y)[:, None] / len(y)
        gh = (g @ w2.T) * (1 - h * h)
        grad = np.concatenate([(X.T @ gh).ravel(), gh.sum(0), (h.T @ g).ravel(), g.sum(0)])
        return value, grad + 2 * ridge * w

    result = minimize(loss, w0, jac=True, method="L-BFGS-B", options={"maxiter": 900})
    return unpack(result.x, f), result.fun


def main(train_dir: Path, validation_dir: Path) -> None:
    X, y, fits, errors = collect(train_dir, 3)
    mean, deviation = X.mean(0), X.std(0) + 1e-6
    sure = np.isfinite(y)  # pieces beside a trunk are neither
    X, y, fits, errors = X[sure], y[sure], fits[sure], errors[sure]
    (w1, b1, w2, b2), fun = train(np.clip((X - mean) / deviation, -4, 4), y)
    print(f"train: {len(y)} candidates, {y.mean():.2f} trees, loss {fun:.3f}")

    def score(F):
        return (np.tanh(np.clip((F - mean) / deviation, -4, 4) @ w1 + b1) @ w2 + b2)[:, 0]

    z = score(X)
    one = (y > 0) & (z > 0) & (errors[:, 2] == 1) & (X[:, 2] > np.log(6))
    A = np.stack([X[one, 3], 0.003475 * fits[one, 13], np.ones(one.sum())], 1)
    print(
        "diameter = a width + b step·range + c:",
        np.linalg.lstsq(A, fits[one, 6] - errors[one, 3], rcond=None)[0].round(3),
        "bias",
        (X[one, 3] - fits[one, 6] + errors[one, 3]).mean().round(4),
    )
    good = (y > 0) & (z > 0) & (errors[:, 2] == 1)
    cls = np.searchsorted(RANGE_EDGES, fits[:, 13])
    factor = np.ones((2, 4))
    for c in range(4):
        m = good & (cls == c)
        for k in (0, 1):
            # 1.4826 m.a.d. and the deviation differ where tails are heavy; the mean of both serves gate and estimate.
            e = errors[m, k] / fits[m, 8 + k]
            factor[k, c] = 0.5 * (np.sqrt(np.mean(np.clip(e, -4, 4) ** 2)) + 1.4826 * np.median(np.abs(e)))
        print(f"class {c}: n {m.sum()}, radial {errors[m, 0].mean():+.3f} ± {errors[m, 0].std():.3f}, "
              f"tangential {errors[m, 1].std():.3f}, diameter {errors[m, 3].mean():+.3f} ± {errors[m, 3].std():.3f}, "
              f"factors {factor[:, c].round(2)}")  # fmt: skip
    out = Path(__file__).parent.parent / "topograph" / "trunks" / "score.json"
    data = {
        "trained_by": "tools/train_score.py",
        "features": list(FEATURES),
        **{k: np.round(v, 5).tolist() for k, v in
           {"mean": mean, "deviation": deviation, "w1": w1, "b1": b1, "w2": w2, "b2": b2,
            "radial_factor": factor[0], "tangential_factor": factor[1]}.items()},
    }  # fmt: skip
    out.write_text(json.dumps(data) + "\n")
    Xv, yv, _, _ = collect(validation_dir, 4)
    Xv, yv = Xv[np.isfinite(yv)], yv[np.isfinite(yv)]
    zv = score(Xv)
    for name, z_, y_ in (("train", z, y), ("validation", zv, yv)):
        p = z_ > 0
        print(f"{name}: precision {y_[p].mean():.3f}, recall of candidates {p[y_ > 0].mean():.3f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
