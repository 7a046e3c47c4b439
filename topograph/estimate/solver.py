"""GTSAM's optimizers, called so that they neither crash on long chains nor hide failure."""

from __future__ import annotations

import math
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


LARGE = 2000
"""Variables from which nested dissection orders them better than minimum degree: measured on runs of ten minutes with an IMU, half the
time."""
NEAR = 1e-2
"""A Gauss-Newton step that raises the error by less than this share, or no share of which lowers it after the one before had gained less, has
converged: robust losses are not quadratic, and the last steps go to and fro."""


def optimised(graph: Any, values: Any, iterations: int, tolerance: float = 1e-5) -> Any:
    """Values that minimise a nonlinear graph: Gauss-Newton as long as it lowers the error, Levenberg-Marquardt where it does not.

    Near the minimum a damped step costs three times as much (damping, retries) and is no better.

    Raises:
        InsufficientDataError: the graph does not determine its variables.
    """
    try:
        return with_big_stack(lambda: _optimised(graph, values, iterations, tolerance))
    except RuntimeError as err:
        raise InsufficientDataError(f"the data do not determine the path ({str(err).splitlines()[0]})") from err


def ordering_of(graph: Any, variables: int) -> Any:
    """In which the variables of a graph, linear or not, are eliminated."""
    metis = variables > LARGE and not _alone(graph)
    kind = gtsam.Ordering.OrderingType.METIS if metis else gtsam.Ordering.OrderingType.COLAMD
    linear = isinstance(graph, gtsam.GaussianFactorGraph)
    create = gtsam.Ordering.CreateGaussianFactorGraph if linear else gtsam.Ordering.CreateNonlinearFactorGraph
    return create(kind, graph)


def _alone(graph: Any) -> bool:
    """Whether a variable shares no factor with another one (a tree none of whose sightings is believed): METIS would be handed an
    adjacency without it and read beyond its end.
    """
    keys: set[int] = set()
    joined: set[int] = set()
    for k in range(graph.size()):
        mine = graph.at(k).keys()
        (joined if len(mine) > 1 else keys).update(mine)
    return not keys <= joined


def _optimised(graph: Any, values: Any, iterations: int, tolerance: float) -> Any:
    ordering = ordering_of(graph, values.size())
    error, gain = graph.error(values), math.inf
    for k in range(iterations):
        try:
            now, moved = _step(graph, values, graph.linearize(values).optimize(ordering), error)
        except RuntimeError:  # a variable that no factor holds here: damping may carry it to where one does
            now, moved = math.inf, values
        if not now <= error:  # NaN too
            if k > 0 and (now < (1.0 + NEAR) * error or gain < NEAR * error):
                return values
            return _levenberg_marquardt(graph, values, ordering, iterations - k, tolerance)
        gain = error - now
        converged = gain < tolerance * error
        values, error = moved, now
        if converged:
            break
    return values


SHARES = (1.0, 0.5, 0.25)
"""Of a Gauss-Newton step that are tried: robust losses and ranges of what lies near are not quadratic, and a whole step may go too far."""


def _step(graph: Any, values: Any, delta: Any, error: float) -> tuple[float, Any]:
    """Error and values after the largest share of a step that lowers the error, or after the whole step where none does."""
    whole: tuple[float, Any] | None = None
    for share in SHARES:
        moved = values.retract(delta if share == 1.0 else delta.scale(share))
        now = graph.error(moved)
        whole = whole or (now, moved)
        if now <= error:
            return now, moved
    assert whole is not None
    return whole


def _levenberg_marquardt(graph: Any, values: Any, ordering: Any, iterations: int, tolerance: float) -> Any:
    p = gtsam.LevenbergMarquardtParams()
    p.setRelativeErrorTol(tolerance)
    p.setMaxIterations(iterations)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, ordering, p).optimize()
