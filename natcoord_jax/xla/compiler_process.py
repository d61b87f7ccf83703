"""A process that compiles programs for another one, until that ends.

In a thread, the compiler could not be stopped, and an interpreter that ends meanwhile crashes. What is sent
is a program of `jax.export`, and what comes back is machine code. This file is run by itself, and imports
nothing of this package.
"""

import os
import pickle
import queue
import sys
import threading
from typing import IO, Any

LENGTH = 8
"""Bytes that say how many follow."""


def send(stream: IO[bytes], content: bytes) -> None:
    """Write bytes so that they can be told from those that follow."""
    stream.write(len(content).to_bytes(LENGTH, "little") + content)
    stream.flush()


def receive(stream: IO[bytes]) -> bytes:
    """Read what was sent.

    Raises:
        EOFError: if the other process ends.
    """
    length = int.from_bytes(_exactly(stream, LENGTH), "little")
    return _exactly(stream, length)


def _exactly(stream: IO[bytes], count: int) -> bytes:
    content = stream.read(count)
    if len(content) < count:
        raise EOFError("the process that compiles has ended")
    return content


def compiled(request: dict[str, Any]) -> bytes:
    """A program, compiled: its code and the structures of its arguments and results.

    Args:
        request: `settings` of JAX, `fields` of a program of `jax.export` (each pickled), the `shapes` and
            types of its two lists of arguments, and `options` of the compiler.
    """
    import jax
    from jax import export
    from jax.experimental.serialize_executable import serialize

    for name, value in request["settings"].items():
        jax.config.update(name, value)
    fields = {name: pickle.loads(field) for name, field in request["fields"].items()}
    program = export.Exported(**fields)
    shapes = [[jax.ShapeDtypeStruct(*x) for x in arrays] for arrays in request["shapes"]]
    lowered = jax.jit(program.call, donate_argnums=0).lower(*shapes)
    return pickle.dumps(serialize(lowered.compile(request["options"])))


def main() -> None:
    """Answer what comes on the standard input, and end with it."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed is no answer
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        try:
            while True:
                requests.put(receive(sys.stdin.buffer))
        finally:
            os._exit(0)  # whatever is being compiled, nobody waits for it

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            said, found = b"well", compiled(pickle.loads(requests.get()))
        except Exception as error:  # (It is told to the other process, which goes on without.)
            said, found = b"failed", f"{type(error).__name__}: {error}".encode()
        send(answers, said)
        send(answers, found)


if __name__ == "__main__":
    main()
