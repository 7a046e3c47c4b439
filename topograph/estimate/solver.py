"""GTSAM's optimizers, called so that they neither crash on long chains nor hide failure."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import gtsam

from topograph.errors import InsufficientDataError

_T = TypeVar("_T")


def with_big_stack(work: Callable[[], _T]) -> _T:
    """Run `work` in a thread with 512 MB of stack: elimination trees of long runs recurse deeper than 8 MB allow."""
    result: list[_T] = []
    failure: list[BaseException] = []

    def run() -> None:
        try:
            result.append(work())
        except BaseException as err:  # noqa: BLE001  # handed to the caller below
            failure.append(err)

    before = threading.stack_size(512 << 20)
    try:
        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    if failure:
        raise failure[0]
    return result[0]


def levenberg_marquardt(graph: Any, values: Any, iterations: int, tolerance: float = 1e-5) -> Any:
    """Optimised Values.

    Raises:
        InsufficientDataError: the graph does not determine its variables.
    """
    p = gtsam.LevenbergMarquardtParams()
    p.setRelativeErrorTol(tolerance)
    p.setMaxIterations(iterations)
    p.setOrderingType("METIS" if values.size() > 5000 else "COLAMD")
    try:
        return with_big_stack(lambda: gtsam.LevenbergMarquardtOptimizer(graph, values, p).optimize())
    except RuntimeError as err:
        raise InsufficientDataError(f"the data do not determine the path ({str(err).splitlines()[0]})") from err
