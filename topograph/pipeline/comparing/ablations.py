"""One part left out in turn."""

from __future__ import annotations

from dataclasses import replace

from topograph.config import Config
from topograph.errors import TopographError
from topograph.evaluate.comparison import Row
from topograph.mapping import Progress
from topograph.pipeline.comparing.runs import without
from topograph.pipeline.comparing.work import Work, add_map
from topograph.pipeline.mapping import solve_run, topo_map


def ablated(config: Config) -> dict[str, Config]:
    """What is left out -> the configuration without it."""
    b, e, t = config.bags, config.estimate, config.trees
    return {
        "nothing": config,
        "IMU factors (gyro in dead reckoning stays)": replace(config, estimate=replace(e, use_imu=False)),
        "IMU": replace(config, bags=replace(b, topic_imu="none")),
        "dual-antenna heading": replace(config, bags=replace(b, topic_heading="none")),
        "GNSS": replace(config, bags=replace(b, topic_fix="none", topic_heading="none")),
        "wheels": replace(config, bags=replace(b, topic_odometry="none")),
        "robust losses": replace(config, estimate=replace(e, huber=1e6, tukey=1e6)),
        "learned noise scales": replace(config, estimate=replace(e, learn_scale=False)),
        "re-association": replace(config, trees=replace(t, reassociate=False)),
        "existence by free space": replace(config, trees=replace(t, passed=1e6)),
        "score (all candidates alike)": replace(config, trees=replace(t, usual_score=0.0, min_share=0.0)),
    }


def ablations_of(w: Work, config: Config, progress: Progress) -> None:
    """Each part left out in turn, on the first run's detections."""
    out, first, truth = w.out, w.first, w.truths[0]
    heard = w.heard["organised", first]
    cases = ablated(config)
    for k, (name, c) in enumerate(cases.items()):
        progress("ablations", k / len(cases))
        session = without(heard, c).session
        try:
            s = solve_run(session, c)
        except TopographError as err:
            out.rows.append(Row("ablations", f"without {name}", first, []))
            out.notes.append(f"without {name}: {err}")
            continue
        topo = topo_map(s, c, {}, clouds=False)
        add_map(w, "ablations", f"without {name}", topo, truth, (s.estimate.stamps_ns, s.estimate.map_T_robot))
    progress("ablations", 1.0)
