"""Runs of a solver that asks for one point after the other, side by side: their points make one batch."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from queue import SimpleQueue
from typing import Any

import numpy as np

Ask = Callable[[np.ndarray], Any]


class StoppedError(Exception):
    """The user has stopped it; runs end with what they have."""


def side_by_side(
    evaluate: Callable[[np.ndarray], list[Any]], points: np.ndarray, runs: dict[int, Callable[[Ask], Any]]
) -> dict[int, Any]:
    """Results of runs, each in a thread of its own.

    A solver of a library calls back for one point. Where all runs wait for theirs, one program evaluates
    all of them; lanes whose run has ended keep their last point, so that the program is always the same.

    Args:
        evaluate: points (lanes, n) to what belongs to each of them. It is called from this thread.
        points: one for each lane (lanes, n).
        runs: by lane; each is given a function of a point.

    Raises:
        Exception: what a run or `evaluate` raises. An interruption from the keyboard is handed to the runs
            as `StoppedError`.
    """
    points, asked = np.array(points), SimpleQueue()
    answers = {lane: SimpleQueue() for lane in runs}

    def ask(lane: int, point: np.ndarray) -> Any:
        asked.put((lane, np.array(point)))
        found = answers[lane].get()
        if isinstance(found, BaseException):
            raise found
        return found

    def thread(lane: int) -> Any:
        try:
            return runs[lane](partial(ask, lane))
        finally:
            asked.put((lane, None))

    with ThreadPoolExecutor(len(runs)) as pool:
        futures = {lane: pool.submit(thread, lane) for lane in runs}
        running, stopped = len(runs), False
        while running:
            waiting: list[int] = []
            try:
                while len(waiting) < running:
                    lane, point = asked.get()
                    if point is None:
                        running -= 1
                    else:
                        waiting.append(lane)
                        points[lane] = point
                found: Any = [StoppedError()] * len(points) if stopped or not waiting else evaluate(points)
            except KeyboardInterrupt:
                stopped, found = True, [StoppedError()] * len(points)
            except Exception as error:
                found = [error] * len(points)
            for lane in waiting:
                answers[lane].put(found[lane])
        return {lane: future.result() for lane, future in futures.items()}
