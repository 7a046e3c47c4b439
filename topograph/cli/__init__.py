"""Words -> pipeline -> report. The only place that prints and exits."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    # Before numpy is loaded: its matrices are small here, and threads that wait for work double the cost of a sweep.
    os.environ.setdefault(_name, "1")

from topograph.cli import commands, comparing, inspecting, living, localizing, mapping, viewing  # noqa: E402, F401  # they register themselves
from topograph.cli.common import main  # noqa: E402  # after the threads

__all__ = ["main"]
