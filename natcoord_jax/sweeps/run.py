"""A sweep: blocks of variants, in this process or by an executor, on all devices, written as they come."""

import concurrent.futures as futures
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.jit import jit
from natcoord_jax.core.kinds import FLAG, Anything, FunctionOf, of
from natcoord_jax.core.numeric import Whole
from natcoord_jax.stepping.room import Steps
from natcoord_jax.stepping.segments import progress_bar
from natcoord_jax.sweeps.grid import Grid
from natcoord_jax.sweeps.table import Sweep, check_same, create, made_elsewhere, zarr

BLOCK = 4096
"""Rows of a block, at most, where it is not said."""

WAITING = 64
"""Blocks that an executor is given at once."""


@checked()
def sweep(
    function: Annotated[Callable[..., Any], FunctionOf("of the axes, by name, to arrays")],
    axes: Annotated[Mapping[Any, Any], of("a dictionary of names and values", dict)],
    *,
    store: Annotated[
        str | os.PathLike | None, of("the name of a folder, or its path", str, os.PathLike)
    ] = None,
    executor: Annotated[futures.Executor | None, Anything()] = None,
    block: Annotated[int | None, Whole(1)] = None,
    buckets: Annotated[Sequence[str], of("names of axes, as ('steps',)", tuple, list)] = (),
    progress: Annotated[bool, FLAG] = False,
) -> Sweep:
    """Evaluate a function for all combinations of some values, from thousands to billions of them.

    Blocks of variants are worked through by one program, on all devices of the machine at once (`shard_map`
    over the lanes), and are written as they come. Every row has its place: a sweep that was killed goes on
    when it is called again with the same store, and no row is missing or there twice.

    Lanes that fail do not raise: return `trajectory.result` under the name "result", and every row has its
    code, see `Sweep.explain`.

    Over many processes or machines blocks go by an executor, as `concurrent.futures.ProcessPoolExecutor`
    (with the start method "spawn": JAX does not survive a fork), that of `dask.distributed`
    (`client.get_executor()`), of `submitit` or of `mpi4py`. The workers write themselves, to a store that all
    of them see, and import the function by its name. Where `jax.distributed` is initialised every process
    calls this, and takes its share of the blocks, on its own devices.

    Args:
        function: of one variant, called with the values by name; of traced numbers, under `jax.vmap`. It
            returns arrays, as a dictionary. In workers it has to be importable, at the top of a module; and
            so should be the scene that it simulates, compiled once, and not within the function.
        axes: values by name, along the first axis of an array; under a tuple of names, as many arrays, whose
            values change together: `{("dt", "steps"): ([0.1, 0.05], [10, 20])}`.
        store: folder that results are written to (Zarr 3); None: they are kept in memory.
        executor: where blocks are worked through; None: in this process.
        block: rows of a block, by default 4096: what is computed at once, and lost by a kill.
        buckets: names of those axes that are numbers of steps. The function is given `nc.Steps`, which
            `nc.simulate` takes as `steps`, with room for as many as others of about that number need: one
            program a bucket (64, 256, 1024, ...).
        progress: show a bar, as in `nc.simulate`.

    Returns:
        What was found, see `Sweep`.

    Raises:
        ValueError: for axes that do not fit, a store of another sweep, or an executor without a store.
        RuntimeError: if the executor has lost a block; all others are there, and calling again goes on.
        ImportError: without `zarr`.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.PointMass(mass=1.0, velocity=(1.0, 0.0, 0.0), name="ball"))
        >>> gravity = scene.add(nc.Gravity())
        >>> system, state = scene.compile()
        >>> def fall(mass, dt, steps):
        ...     run = nc.simulate(system.set("ball", mass=mass), state, dt=dt, steps=steps)
        ...     return {"height": run.q[-1, 0, 2], "result": run.result}
        >>> found = nc.sweep(fall, {"mass": [1.0, 2.0], ("dt", "steps"): ([0.1, 0.05], [10, 20])},
        ...                  buckets=("steps",))
        >>> found["height"].round(6).tolist()
        [[-4.905, -4.905], [-4.905, -4.905]]
    """
    size = block or min(BLOCK, int(np.prod([len(_first(x, k)) for k, x in axes.items()], dtype=np.int64)))
    size = -(-size // len(jax.local_devices())) * len(jax.local_devices())
    grid = Grid.of(axes, buckets, size)
    if executor is not None and store is None:
        raise ValueError("executor: workers need a folder that all of them see; pass its name as `store`")
    found = _table(function, grid, store)
    todo = [int(k) for k in np.flatnonzero(~found.done_blocks)]
    if executor is None:
        # By number, not by place in the list, of which the others may have done some already.
        todo = [k for k in todo if k % jax.process_count() == jax.process_index()]
    with progress_bar(grid.rows, int(found.done.sum()), progress, "row") as show:
        if executor is None:
            for number in todo:
                show(_worked(function, found, number))
            while jax.process_count() > 1 and not found.complete:
                time.sleep(0.1)  # (A process that ends before the others would end the job.)
        else:
            _handed_out(executor, (function, str(store)), todo, show, found)
    return found


def _first(values: Any, key: Any) -> Any:
    return values[0] if isinstance(key, tuple) else np.atleast_1d(values)


def _called(function: Callable[..., Any]) -> str:
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return f"{getattr(function, '__module__', '')}:{name}"


def _table(function: Callable[..., Any], grid: Grid, store: Any) -> Sweep:
    """The store, as it is or made anew."""
    if store is not None:
        path = Path(store)
        if jax.process_index() > 0:
            found = made_elsewhere(path)
        elif (path / "zarr.json").exists():
            found = Sweep(path)
        else:
            return create(str(path), grid, _shapes(function, grid), _called(function))
        check_same(found, grid, _called(function), path)
        return found
    return create(zarr().storage.MemoryStore(), grid, _shapes(function, grid), _called(function))


def _shapes(function: Callable[..., Any], grid: Grid) -> Any:
    values = {name: x[0] for name, x in grid.values(np.zeros(1, int)).items()}
    rooms = grid.block(0).rooms
    return jax.eval_shape(lambda values: _lane(function, rooms, values), values)


def _lane(function: Callable[..., Any], rooms: Iterable[tuple[str, int]], values: dict[str, Any]) -> Any:
    steps = {name: Steps(values[name], room) for name, room in rooms}
    return function(**{**values, **steps})


def _worked(function: Callable[..., Any], table: Sweep, number: int) -> int:
    """Work through a block; returns the number of its rows."""
    block = table.grid.block(number)
    rows = np.minimum(block.first + np.arange(table.grid.size), block.first + block.count - 1)
    program = _program(function, block.rooms, len(jax.local_devices()), table.grid.blocks > 1)
    values = table.grid.values(rows)
    table.write(number, block, program(values))
    return block.count


@lru_cache(maxsize=64)
def _program(function: Callable[..., Any], rooms: tuple, devices: int, several: bool) -> Callable[..., Any]:
    """All lanes of a block at once, on all devices."""

    def lanes(values: dict[str, Any]) -> Any:
        return jax.vmap(lambda one: _lane(function, rooms, one))(values)

    if devices > 1:
        mesh = Mesh(np.array(jax.local_devices()), ("lanes",))
        split = PartitionSpec("lanes")
        return jax.jit(jax.shard_map(lanes, mesh=mesh, in_specs=split, out_specs=split, check_vma=False))
    # With full effort from the start, every block is computed by the same program.
    return jit(lanes, effort="full" if several else None)


def work(function: Callable[..., Any], store: str, number: int) -> int:
    """Work through a block, in a worker; returns the number of its rows."""
    jax.config.update("jax_enable_x64", True)
    return _worked(function, _opened(store), number)


@lru_cache(maxsize=4)
def _opened(store: str) -> Sweep:
    return Sweep(store)


def _handed_out(executor: Any, given: tuple, todo: list[int], show: Any, found: Sweep) -> None:
    """Give blocks to an executor, some at a time."""
    left, running, begun = iter(todo), {}, int(found.done_blocks.sum())
    try:
        while True:
            for number in left:
                running[executor.submit(work, *given, number)] = number
                if len(running) >= WAITING:
                    break
            if not running:
                return
            ended, _ = futures.wait(running, return_when=futures.FIRST_COMPLETED)
            for future in ended:
                show(future.result())
                del running[future]
    except (futures.BrokenExecutor, OSError) as error:
        done = int(found.done_blocks.sum())
        remedy = "call nc.sweep again with the same store and a new executor to go on"
        if done == begun:
            remedy = (
                "none by this call, and what workers print says why; those that are spawned import the "
                'script: what it does belongs below `if __name__ == "__main__":`'
            )
        count = f"{done} of {found.grid.blocks} blocks are done"
        raise RuntimeError(f"the executor has lost a worker ({error}); {count}: {remedy}") from error
    finally:
        for future in running:
            future.cancel()
