"""Trains the network of topograph/trunks/score.py, with PyTorch (`pip install -e '.[train]'`); it runs on numpy."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from topograph.geometry import Array
from topograph.trunks.score import ALONE, LEAST, Layers

WIDTHS = (128, 64, 64)
"""Of the layers: two that describe a candidate, one that judges it beside the trees of its sweep."""
DROPOUT = 0.1
SWEEPS = 24
"""In one step."""
RATE, DECAY = 2e-3, 1e-4
ASIDE = 0.5
"""Weight of the loss of the first judgement: it must mean something, since it says which candidates are the sweep's trees."""


class Network(nn.Module):
    """As `topograph.trunks.score.judge`, where it is explained."""

    def __init__(self, features: int) -> None:
        super().__init__()
        a, b, c = WIDTHS
        self.describe = nn.Sequential(
            nn.Linear(features, a), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(a, b), nn.ReLU()
        )
        self.alone = nn.Linear(b, 3)
        self.beside = nn.Sequential(nn.Linear(2 * b + 5, c), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(c, 3))

    def forward(self, x: Tensor, sweep: Tensor, n: int) -> tuple[Tensor, Tensor]:
        """Scores (N, 3) of each candidate by itself, and beside the others of its sweep (0 to n - 1)."""
        h = self.describe(x)
        z = self.alone(h)
        p = torch.softmax(z, 1)
        mass = torch.zeros(n, 2).index_add(0, sweep, p[:, :2])
        total = torch.zeros(n, h.shape[1]).index_add(0, sweep, p[:, :1] * h)
        others = (mass[sweep] - p[:, :2]).clamp(min=0)
        mean = (total[sweep] - p[:, :1] * h) / (others[:, :1] + ALONE)
        seen = torch.cat([h, torch.log_softmax(z, 1).clamp(min=-LEAST), torch.log1p(others), mean], 1)
        return z, z + self.beside(seen)

    def layers(self) -> Layers:
        """Weights and offsets, as the program uses them."""
        parts = {}
        for name, module in (("describe", self.describe), ("alone", [self.alone]), ("beside", self.beside)):
            linear = [m for m in module if isinstance(m, nn.Linear)]
            parts[name] = [q.detach().numpy().copy() for m in linear for q in (m.weight.T, m.bias)]
        return Layers(**parts)


def train(X: NDArray[np.float32], y: NDArray[np.int64], w: Array, sweep: NDArray[np.int64], epochs: int = 24) -> Layers:
    """Layers for normalised features X (N, F), classes y (N,), -1 where nobody knows, weights and sweeps (N,).

    AdamW on the weighted cross entropy, one cycle of the rate (Smith 2018), whole sweeps at a time.
    """
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    network = Network(X.shape[1])
    order = np.argsort(sweep, kind="stable")
    _, starts = np.unique(sweep[order], return_index=True)
    ends = np.append(starts, len(order))
    if len(starts) < SWEEPS:
        raise SystemExit(f"{len(starts)} sweeps with candidates; at least {SWEEPS} are needed to train")
    A, target = torch.from_numpy(np.ascontiguousarray(X)), torch.from_numpy(np.maximum(y, 0))
    weight = torch.from_numpy((np.where(y >= 0, w, 0.0) / w[y >= 0].mean()).astype(np.float32))
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    per_epoch = len(starts) // SWEEPS
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=epochs * per_epoch + 1, pct_start=0.1)
    for epoch in range(epochs):
        lot, total = rng.permutation(len(starts)), 0.0
        for i in range(per_epoch):
            chosen = lot[i * SWEEPS : (i + 1) * SWEEPS]
            rows = torch.from_numpy(np.concatenate([order[ends[k] : ends[k + 1]] for k in chosen]))
            group = torch.from_numpy(np.repeat(np.arange(SWEEPS), ends[chosen + 1] - ends[chosen]))
            first, second = network(A[rows], group, SWEEPS)
            loss = sum(
                share * nn.functional.cross_entropy(z, target[rows], reduction="none")
                for share, z in ((ASIDE, first), (1.0, second))
            )
            mean = (loss * weight[rows]).mean()
            optimizer.zero_grad()
            mean.backward()
            optimizer.step()
            rate.step()
            total += mean.item() / per_epoch
        if epoch % 6 == 5:
            print(f"epoch {epoch + 1}: loss {total:.4f}", flush=True)
    return network.eval().layers()
