"""Programs compiled in another process, see `compiler_process`.

The thread that waits for them handles nothing but bytes: an interpreter that ends while a thread is within
JAX crashes.
"""

import atexit
import dataclasses
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax import export
from jax.experimental.serialize_executable import deserialize_and_load

from natcoord_jax.xla import kept
from natcoord_jax.xla.compiler_process import receive, send

IDLE = 30.0
"""Time [s] after which a process without work ends: it takes some hundred megabytes."""

SETTINGS = ("jax_enable_x64",)
"""Settings of JAX that the process shares."""


class Compilation:
    """A program that is compiled elsewhere.

    Args:
        program: exported.
        shapes: of its two lists of arguments, the first to be used again.
        options: of the compiler.

    Attributes:
        request: what the process is asked.
        answer: what it says, once it has: whether all went well, and the code or the reason.
    """

    def __init__(self, program: export.Exported, shapes: tuple[list, list], options: dict[str, Any]):
        fields = {x.name: _pickled(getattr(program, x.name)) for x in dataclasses.fields(program)}
        listed = [[(x.shape, x.dtype) for x in arrays] for arrays in shapes]
        settings = {name: getattr(jax.config, name) for name in SETTINGS}
        self.request = pickle.dumps(dict(settings=settings, fields=fields, shapes=listed, options=options))
        self.answer: tuple[bool, bytes] | None = None

    def loaded(self) -> Callable:
        """The program.

        Raises:
            RuntimeError: if it could not be compiled.
        """
        assert self.answer is not None
        well, found = self.answer
        if not well:
            raise RuntimeError(found.decode())
        return deserialize_and_load(*pickle.loads(found))


class Elsewhere:
    """A thread that has programs compiled one after the other, and the process that does it."""

    def __init__(self) -> None:
        self._work: queue.SimpleQueue[Compilation] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen | None = None
        self._starting = threading.Lock()

    def compile(self, work: Compilation) -> None:
        """Compile it in its turn."""
        with self._starting:
            self._work.put(work)
            # (After a fork, the thread is that of the other process, as is its work.)
            if self._thread is None or not self._thread.is_alive():
                self._process = None
                self._thread = threading.Thread(target=self._run, name="natcoord_jax compiles", daemon=True)
                self._thread.start()

    def end(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

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
                work.answer = self._answer(work.request)
            except (OSError, EOFError) as error:  # (The process could not be started, or was ended.)
                work.answer = False, str(error).encode()

    def _answer(self, request: bytes) -> tuple[bool, bytes]:
        code = kept.get(request)
        if code is not None:
            return True, code
        process = self._started()
        assert process.stdin is not None and process.stdout is not None
        send(process.stdin, request)
        well, found = receive(process.stdout) == b"well", receive(process.stdout)
        if well:
            kept.put(request, found)
        return well, found

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


def _pickled(value: Any) -> bytes:
    """A field of a program; nothing for what only derivatives of it would ask for."""
    try:
        return pickle.dumps(value)
    except (AttributeError, TypeError, pickle.PicklingError):
        return pickle.dumps(None)


elsewhere = Elsewhere()
atexit.register(elsewhere.end)
