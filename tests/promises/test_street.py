"""A recorded street (../shared/data/street_avenue): what moved, or was seen through, is not in its map."""

from pathlib import Path

import numpy as np
import pytest
import recordings as rec

from topograph.config import Config
from topograph.geometry import transform
from topograph.mapping import map_T_scans
from topograph.pipeline import audited, read_run, solve_run


def test_nodes_stand_still_and_stop_the_beam(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    bag = rec.street_bag(tmp_path_factory.mktemp("street") / "street.bag", 4)
    config = Config()
    solved = solve_run(read_run([bag], config), config)
    e, d = solved.existence, solved.detections
    assert len(e.ok) >= 20
    assert (e.passed <= e.hits).all()
    seen = transform(map_T_scans(solved)[d.scan], d.p)[:, :2]
    for tree in range(len(e.ok)):
        mine = np.flatnonzero(solved.tree == tree)
        part = len(mine) // 4
        if part < 3:  # one odd sighting of a few is no motion
            continue
        shift = np.median(seen[mine[-part:]], axis=0) - np.median(seen[mine[:part]], axis=0)
        # A pillar a metre thick shows another side when passed; a vehicle that moves goes further.
        assert np.linalg.norm(shift) < 1.0
    assert any("moved" in n for n in solved.run.notes)
    # Masts and pillars are called trees here, two of three; the map does not say so without a word.
    assert any(f.name == "kinds" for f in audited(solved).findings)
