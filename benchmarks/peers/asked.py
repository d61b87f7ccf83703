"""A peer that waits: it solves once for every line that it reads, so that codes can be timed in turn."""

import json
import sys
import time
from collections.abc import Callable
from typing import Any


def serve(solve: Callable[[], dict[str, Any]], about: dict[str, Any]) -> None:
    """Print what it is; then, for each line of standard input, solve and print the result with its times.

    `seconds` are those of the clock, `processor_s` those of the processor, which other jobs do not change.

    Args:
        solve: one solution; it returns cost, iterations and outcome.
        about: of the peer; with the seconds of its setup.
    """
    print(json.dumps(about), flush=True)
    for _ in sys.stdin:
        start, busy = time.perf_counter(), time.process_time()
        found = solve()
        times = {"seconds": time.perf_counter() - start, "processor_s": time.process_time() - busy}
        print(json.dumps(times | found), flush=True)
