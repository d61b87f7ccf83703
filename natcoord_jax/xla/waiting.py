"""What is being waited for, said where somebody sees it."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PATIENCE = 2.0
"""Time [s] from which on it is said what takes so long."""

_last: list[float] = []
"""How long the last program took [s]."""

_all = [0.0]
"""How long all of them took [s]."""


class Stopwatch:
    """A watch that stands still while programs are compiled."""

    def __init__(self) -> None:
        self.begun = time.monotonic() - _all[0]

    @property
    def seconds(self) -> float:
        """Time since it was started [s]."""
        return time.monotonic() - _all[0] - self.begun


@contextmanager
def told(name: str) -> Iterator[None]:
    """Say on a terminal that a program is being compiled, if that takes long."""
    begun = time.monotonic()
    said = threading.Event()

    def say() -> None:
        said.set()
        before = f" (the last program took {_last[0]:.1f} s)" if _last else ""
        print(f"compiling {name}{before} ...", end="", file=sys.stderr, flush=True)

    terminal = sys.stderr is not None and sys.stderr.isatty()
    timer = threading.Timer(PATIENCE, say)
    timer.daemon = True
    if terminal:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
        taken = time.monotonic() - begun
        _last[:] = [taken]
        _all[0] += taken
        if said.is_set():
            print(f" {taken:.1f} s", file=sys.stderr, flush=True)
