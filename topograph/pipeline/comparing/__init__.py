"""Both methods on the same runs: three questions, each with its own inputs.

A: the same detections, another estimator. B: the same map and trunks, another localizer. C: whole chain against whole chain. Between them
stand all eight combinations of front end, map and localizer.
"""

from topograph.pipeline.comparing.compare import compare_runs
from topograph.pipeline.comparing.runs import with_fixes

__all__ = ["compare_runs", "with_fixes"]
