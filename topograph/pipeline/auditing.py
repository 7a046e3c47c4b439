"""The audit of a solved run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from topograph import audit
from topograph.audit import Finding, Verdict
from topograph.geometry import Array
from topograph.mapping import Solved
from topograph.motion import mount_turn
from topograph.topomap.map import TREE


def audited(solved: Solved) -> Verdict:
    """Whether to believe it."""
    p, e = solved.problem, solved.estimate
    found = [
        *(f for f in audit.offsets(p, e) if not p.placed or f.name not in ("fix clock", "antenna")),
        *(() if p.placed else _of_gnss(solved)),
        *audit.trunks(p, e, solved.moving, solved.existence.kind == TREE),
        *_unclaimed(solved),
        *_seldom(solved),
        *audit.unsure(solved.existence.probability[_own_trees(solved)]),
        *audit.rows(solved.loops.slid),
        *audit.way(p, e),
        *audit.seam(p, e),
        *_mounts(solved),
    ]
    if any(f.name == "moving" for f in found):  # the same cause, and said of it
        found = [f for f in found if f.name != "trunks of no tree"]
    return Verdict(tuple(sorted(found, key=lambda f: (not f.refuses, -f.value / f.bound))))


def _of_gnss(solved: Solved) -> Iterator[Finding]:
    """What fixes and headings say; places in a map that the localizer found are none."""
    p, e = solved.problem, solved.estimate
    yield from audit.fixes(p, e)
    yield from audit.jumps(p, e, solved.streams, _lever(solved))
    yield from audit.standing(solved.streams, solved.motion)
    yield from audit.headings(p, e)


def _own_trees(solved: Solved) -> NDArray[np.bool_]:
    """(T,) trees of this run: what an earlier map knows, few looks do not make doubtful."""
    own = solved.existence.kind == TREE
    if solved.problem.known is not None:
        known = solved.problem.known.tree
        own[known[known >= 0]] = False
    return np.asarray(own)


def _seldom(solved: Solved) -> Iterator[Finding]:
    first, last = solved.motion.stamps_ns[[0, -1]]
    d = solved.detections
    inside = (d.stamps_ns >= first) & (d.stamps_ns <= last)
    shown = np.unique(d.scan[solved.tree >= 0])
    yield from audit.seldom(int(inside.sum()), int(inside[shown].sum()))


def _unclaimed(solved: Solved) -> Iterator[Finding]:
    first, last = solved.motion.stamps_ns[[0, -1]]  # what dead reckoning does not cover cannot be mapped
    scans = solved.run.trunks
    within = (scans.stamps_ns >= first) & (scans.stamps_ns <= last)
    if not within.any():
        return
    inside = np.repeat(within, np.diff(scans.ends))
    d = solved.detections
    sure = d.score >= 0
    yield from audit.unclaimed(scans.p[inside], scans.score[inside], d.p[sure], solved.tree[sure])


TURNED = np.radians(45.0)
"""An IMU whose accelerations fit a mounting turned by more than this is mounted otherwise than was said."""


def _lever(solved: Solved) -> Array:
    """The antenna's place (3,) in the robot's frame, m; the origin where nobody says."""
    mount = solved.run.mounts.get("fix")
    return np.zeros(3) if mount is None else mount[:3, 3]


def _mounts(solved: Solved) -> list[Finding]:
    """Mountings that nobody gave, and the IMU's."""
    out = []
    run = solved.run
    if solved.problem.datum is not None and run.mounts.get("fix", 0) is None:
        out.append(
            Finding(
                name="antenna unknown", value=1.0, bound=0.0001, unit="",
                sentence=f"nobody says where the antenna sits (frame {run.streams.frames['fix']!r} is not in TF): the map lies off by its lever arm; "
                f"add --extrinsic {run.streams.frames['fix'] or 'fix'}=X,Y,Z,ROLL,PITCH,YAW",
            )
        )  # fmt: skip
    mount = run.mounts.get("imu")
    if mount is not None and solved.problem.inertial is not None:
        turn, sigma = mount_turn(solved.streams, mount)
        if abs(turn) > max(TURNED, 3.0 * sigma) and sigma < 0.5:
            out.append(
                Finding(
                    name="imu turned", value=abs(turn), bound=TURNED, unit="rad",
                    sentence=f"the IMU's accelerations fit a mounting turned by {np.degrees(turn):.0f}° ± {np.degrees(sigma):.0f}° from what TF says",
                )
            )  # fmt: skip
    return out
