"""Trains the score of the trunk front end, and the factors of its covariances, on simulated bags.

    python tools/train_score.py TRAIN_DIR VALIDATION_DIR

Both folders hold bags of `topograph simulate` with their truth. Orchards of the validation folder are of a design
that the training folder does not have. Weights go to topograph/trunks/score.json. Seeds: the bags' own (grid 100-102,
steep 120-122, gentle 130-132, hedgerow 140-142; validation: olive 110-112; 40 s each); 0 for weights and shuffle.
"""

from __future__ import annotations

import json
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from topograph.bags import Recording, Scan
from topograph.evaluate.truth import Truth
from topograph.geometry import Array, interpolate, inverse, transform
from topograph.motion import StreamsBuilder, twist_during
from topograph.trunks.config import TrunksConfig
from topograph.trunks.detector import Detector, candidates
from topograph.trunks.fit import FEATURES, RANGE_EDGES
from topograph.trunks.score import calibration, forward, weights

HIDDEN = (48, 24)


def collect_one(bag: Path, every: int) -> tuple[Array, Array, Array, Array, Array]:
    """Features (N, F), labels (N,), fits (N, 16), errors (N, 4): radial, tangential, stems, diameter; and the true visible
    trees of each scan by range class and how many of them have a candidate (4, 2)."""
    truth = Truth.load(bag.with_name(bag.stem + ".truth"))
    X, y, fits, errors = [], [], [], []
    ceiling = np.zeros((4, 2))
    with Recording([bag]) as r:
        builder, pending, n = StreamsBuilder(), [], 0
        imu = r.frames.get("imu_link")[:3, :3]
        lidar = np.ascontiguousarray(r.frames.get("velodyne"))
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
            at_scan = np.flatnonzero(truth.scan_stamps_ns == scan.stamp_ns)
            if len(at_scan):
                shown = truth.returns[at_scan[0]] >= 5
                cls = np.searchsorted(RANGE_EDGES, np.hypot(foot[:, 0], foot[:, 1]))
                has = distance.min(axis=0) < 0.5
                for q in range(4):
                    ceiling[q] += [(shown & (cls == q)).sum(), (shown & has & (cls == q)).sum()]
    print(bag.name, sum(map(len, y)), flush=True)
    return np.concatenate(X), np.concatenate(y), np.concatenate(fits), np.concatenate(errors), ceiling


def collect(folder: Path, every: int) -> tuple[Array, Array, Array, Array]:
    """All bags of a folder, two at a time."""
    with ProcessPoolExecutor(2) as pool:
        parts = list(pool.map(partial(collect_one, every=every), sorted(folder.glob("*.bag"))))
    ceiling = sum(p[4] for p in parts)
    print("visible trees with a candidate, by range:", np.round(ceiling[:, 1] / np.maximum(ceiling[:, 0], 1), 3))
    X, y, fits, errors = (np.concatenate([p[k] for p in parts]) for k in range(4))
    return X, y, fits, errors


def normalised(bag: Path, every: int = 8) -> Array:
    """Range class, radial and tangential error over their stated deviations (N, 3) of what the detector gives."""
    truth = Truth.load(bag.with_name(bag.stem + ".truth"))
    out = []
    with Recording([bag]) as r:
        builder, pending, n = StreamsBuilder(), [], 0
        imu = r.frames.get("imu_link")[:3, :3]
        detect = Detector(r.frames.get("velodyne"), TrunksConfig())
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
            trunks = detect(scan, twist)
            T = inverse(interpolate(truth.stamps_ns, truth.world_T_robot, scan.stamp_ns)[0])
            foot, axis = transform(T, truth.trees), truth.axes @ T[:3, :3].T
            for p, cov in zip(trunks.p, trunks.cov, strict=True):
                e = p[:2] - foot[:, :2] - ((p[2] - foot[:, 2]) / axis[:, 2])[:, None] * axis[:, :2]
                j = int(np.argmin(np.hypot(*e.T)))
                if np.hypot(*e[j]) < 0.3 and truth.stems[j] == 1:
                    reach = np.hypot(*p[:2])
                    line = p[:2] / reach
                    side = np.array([-line[1], line[0]])
                    C = cov[:2, :2]
                    out.append([np.searchsorted(RANGE_EDGES, reach), e[j] @ line / np.sqrt(line @ C @ line), e[j] @ side / np.sqrt(side @ C @ side)])  # fmt: skip
    return np.array(out).reshape(-1, 3)


def _rms(e: Array) -> float:
    """Root mean square of enough values; NaN of fewer."""
    return float(np.sqrt(np.mean(e**2))) if len(e) >= 30 else np.nan


def train(X: Array, y: Array, epochs: int = 40, batch: int = 512, rate: float = 2e-3) -> tuple[list[Array], float]:
    """Weights and offsets of the layers in turn, by Adam (Kingma & Ba 2015) on the log loss; the rate falls as a cosine."""
    rng = np.random.default_rng(0)
    sizes = [X.shape[1], *HIDDEN, 1]
    w: list[Array] = []
    for a, b in pairwise(sizes):
        w += [rng.normal(0, 1 / np.sqrt(a), (a, b)).astype(np.float32), np.zeros(b, np.float32)]
    first, second = [np.zeros_like(q) for q in w], [np.zeros_like(q) for q in w]
    A, target = X.astype(np.float32), y.astype(np.float32)[:, None]
    steps, k, loss = epochs * (len(A) // batch), 0, 0.0
    for epoch in range(epochs):
        order, loss = rng.permutation(len(A)), 0.0
        for i in range(0, len(A) - batch + 1, batch):
            rows = order[i : i + batch]
            h = [A[rows]]
            for q in range(0, len(w) - 2, 2):
                h.append(np.tanh(h[-1] @ w[q] + w[q + 1]))
            z = h[-1] @ w[-2] + w[-1]
            loss += float(np.mean(np.logaddexp(0, z) - target[rows] * z)) / (len(A) // batch)
            g = (1 / (1 + np.exp(-z)) - target[rows]) / batch
            gradient = [None] * len(w)
            for q in range(len(w) - 2, -1, -2):
                gradient[q], gradient[q + 1] = h[q // 2].T @ g, g.sum(0)
                if q:
                    g = (g @ w[q].T) * (1 - h[q // 2] ** 2)
            k += 1
            now = 0.5 * rate * (1 + np.cos(np.pi * k / steps))
            for q in range(len(w)):
                first[q] = 0.9 * first[q] + 0.1 * gradient[q]
                second[q] = 0.999 * second[q] + 0.001 * gradient[q] ** 2
                step = (first[q] / (1 - 0.9**k)) / (np.sqrt(second[q] / (1 - 0.999**k)) + 1e-8)
                w[q] = w[q] - np.float32(now) * (step + 1e-5 * w[q]).astype(np.float32)
        if epoch % 10 == 9:
            print(f"epoch {epoch + 1}: loss {loss:.4f}", flush=True)
    return w, loss


def main(train_dir: Path, validation_dir: Path) -> None:
    X, y, fits, errors = collect(train_dir, 2)
    mean, deviation = X.mean(0), X.std(0) + 1e-6
    sure = np.isfinite(y)  # pieces beside a trunk are neither
    X, y, fits, errors = X[sure], y[sure], fits[sure], errors[sure]
    w, fun = train(np.clip((X - mean) / deviation, -4, 4), y)
    print(f"train: {len(y)} candidates, {y.mean():.2f} trees, loss {fun:.3f}")

    def score(F):
        return forward(np.clip((F - mean) / deviation, -4, 4).astype(np.float32), w)

    z = score(X)
    one = (y > 0) & (z > 0) & (errors[:, 2] == 1) & (X[:, 2] > np.log(6))
    A = np.stack([X[one, 3], 0.003475 * fits[one, 13], np.ones(one.sum())], 1)
    print(
        "diameter = a width + b step·range + c:",
        np.linalg.lstsq(A, fits[one, 6] - errors[one, 3], rcond=None)[0].round(3),
        "bias",
        (X[one, 3] - fits[one, 6] + errors[one, 3]).mean().round(4),
    )
    out = Path(__file__).parent.parent / "topograph" / "trunks" / "score.json"
    data = {
        "trained_by": "tools/train_score.py",
        "features": list(FEATURES),
        **{k: np.round(v, 5).tolist() for k, v in
           {"mean": mean, "deviation": deviation, "radial_factor": np.ones(4), "tangential_factor": np.ones(4)}.items()},
        "layers": [np.round(v.astype(float), 5).tolist() for v in w],
    }  # fmt: skip
    out.write_text(json.dumps(data) + "\n")
    weights.cache_clear()
    calibration.cache_clear()
    with ProcessPoolExecutor(2) as pool:
        bags = list(pool.map(normalised, sorted(train_dir.glob("*.bag"))))
    # The median over bags: an orchard that is harder than the others does not make all others too cautious.
    for k, name in enumerate(("radial_factor", "tangential_factor")):
        rms = [[_rms(e[e[:, 0] == c, 1 + k]) for c in range(4)] for e in bags]
        data[name] = np.round(np.nanmedian(rms, axis=0), 3).tolist()
        print(name, data[name])
    out.write_text(json.dumps(data) + "\n")
    Xv, yv, _, _ = collect(validation_dir, 4)
    Xv, yv = Xv[np.isfinite(yv)], yv[np.isfinite(yv)]
    zv = score(Xv)
    for name, z_, y_ in (("train", z, y), ("validation", zv, yv)):
        p = z_ > 0
        print(f"{name}: precision {y_[p].mean():.3f}, recall of candidates {p[y_ > 0].mean():.3f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
