"""Programs compiled in another process, see `compiler_process`."""

import atexit
import dataclasses
import os
import pickle
import queue
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax import export
from jax.experimental.serialize_executable import deserialize_and_load

from natcoord_jax.xla import kept

IDLE = 30.0
"""Time [s] after which a process without work ends: it takes some hundred megabytes."""

SETTINGS = ("jax_enable_x64",)
"""Settings of JAX that the process shares."""


class Elsewhere:
    """A thread that has programs compiled one after the other, and the process that does it."""

    def __init__(self) -> None:
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen | None = None
        self._starting = threading.Lock()

    def do(self, work: Callable[[], None]) -> None:
        """Do it in the thread, in its turn."""
        with self._starting:
            self._work.put(work)
            # (After a fork, the thread is that of the other process, as is its work.)
            if self._thread is None or not self._thread.is_alive():
                self._process = None
                self._thread = threading.Thread(target=self._run, name="natcoord_jax compiles", daemon=True)
                self._thread.start()

    def compiled(self, function: Any, shapes: tuple[list, list], options: dict[str, Any]) -> Callable:
        """A function of two lists of arrays, the first to be used again, compiled elsewhere.

        Raises:
            Exception: whatever keeps it from being exported (calls back into Python), or compiled.
        """
        program = export.export(function)(*shapes)
        request = {
            "settings": {name: getattr(jax.config, name) for name in SETTINGS},
            "fields": {x.name: _pickled(getattr(program, x.name)) for x in dataclasses.fields(program)},
            "shapes": [[(x.shape, x.dtype) for x in arrays] for arrays in shapes],
            "options": options,
        }
        found = kept.get(request)
        if found is None:
            found = self._answer(request)
            kept.put(request, found)
        return deserialize_and_load(*found)

    def _answer(self, request: dict[str, Any]) -> Any:
        process = self._started()
        assert process.stdin is not None and process.stdout is not None
        pickle.dump(request, process.stdin)
        process.stdin.flush()
        well, found = pickle.load(process.stdout)
        if not well:
            raise RuntimeError(found)
        return found

    def end(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def _started(self) -> subprocess.Popen:
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, str(Path(__file__).with_name("compiler_process.py"))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # (Code that has been read from JAX's cache cannot be sent on.)
                env=os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"},
                start_new_session=True,  # an interrupt is meant for the run
            )
        return self._process

    def _run(self) -> None:
        while True:
            try:
                work = self._work.get(timeout=IDLE)
            except queue.Empty:
                with self._starting:
                    if self._work.empty():
                        self.end()
                        self._thread = None
                        return
                continue
            try:
                work()
            except Exception as error:
                warnings.warn(f"a program could not be compiled with full effort: {error}", stacklevel=1)


def _pickled(value: Any) -> bytes:
    """A field of a program; nothing for what only derivatives of it would ask for."""
    try:
        return pickle.dumps(value)
    except (AttributeError, TypeError, pickle.PicklingError):
        return pickle.dumps(None)


elsewhere = Elsewhere()
atexit.register(elsewhere.end)
