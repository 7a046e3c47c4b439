"""Words -> pipeline -> report. The only place that prints and exits."""

from topograph.cli import commands, inspecting, localizing  # noqa: F401  # they register themselves
from topograph.cli.common import main

__all__ = ["main"]
