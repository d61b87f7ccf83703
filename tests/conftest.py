"""Settings of the test-suite: double precision, a cache of compiled programs, checks of types."""

import ctypes
import gc
import os
from importlib.metadata import version
from pathlib import Path

# A third of the time to compile, for programs that are run briefly; read when the first one is compiled.
# Flags from outside come last and win: XLA_FLAGS=--xla_backend_optimization_level=3 tests what users run.
os.environ["XLA_FLAGS"] = (
    # Compilers from JAX 0.11 on do not have this, and end a process that asks for it.
    ("--xla_cpu_use_fusion_emitters=false " if version("jaxlib").startswith("0.10.") else "")
    + "--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops,"
    + f"while-loop-trip-count-annotator --xla_backend_optimization_level=0 {os.environ.get('XLA_FLAGS', '')}"
)

# With these, a second program with full effort would be the first again.
os.environ.setdefault("NATCOORD_JAX_EFFORT", "quick")

import jax
import pytest
from jaxtyping import install_import_hook

# Tracing makes millions of small objects that live on: looking through them all takes a tenth of the time.
gc.set_threshold(200_000, 50, 100)

ROOT = Path(__file__).resolve().parents[1]
CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(ROOT / ".pytest_cache" / "jax")

# Notebooks and command lines run in processes of their own and share the cache through the environment.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", CACHE)
# Single operations called from Python are programs, too: 30 ms each to compile, hundreds in every process.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)

MAPS, MEMORY = Path("/proc/self/maps"), Path("/proc/self/statm")
MOST_MAPS, MOST_PAGES = 20_000, 750_000
"""Regions and pages of memory (3 GB) of one process at which its compiled programs are given up.

Every program takes a few hundred regions, of which Linux allows 65 530: a process that runs out of them
crashes in the compiler. What compilers have freed stays with the process until it is asked back.
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--check-types", action="store_true", help="check shapes and types at run time")
    parser.addoption("--plain", action="store_true", help="without what xla/ does to programs")
    parser.addoption("--write-golden", action="store_true", help="write the file of test_golden.py anew")
    parser.addoption("--hunt-seeds", type=int, help="random numbers of each structure in test_hunt.py")


def pytest_configure(config: pytest.Config) -> None:
    """Check shapes and types of every annotated function, from the first import on, if asked to.

    Checks take a quarter of the time to trace; `test_types.py` makes them for some scenes.
    """
    if config.option.check_types:
        hook = install_import_hook("natcoord_jax", "beartype.beartype")
        config.add_cleanup(hook.uninstall)
    if config.option.plain:
        from natcoord_jax.core import eager_numpy
        from natcoord_jax.xla import materialise, one_kernel

        one_kernel._attributed = materialise._attributed = None
        eager_numpy.at_top_level = lambda *values: False
        eager_numpy.in_program = lambda *values: True


def pytest_itemcollected(item: pytest.Item) -> None:
    """What is exhaustive for one of its parameters is not slow besides."""
    if item.get_closest_marker("exhaustive"):
        item.own_markers[:] = [mark for mark in item.own_markers if mark.name != "slow"]


@pytest.fixture(autouse=True)
def _room_for_programs():
    yield
    if not MAPS.exists():
        return
    if MAPS.read_bytes().count(b"\n") > MOST_MAPS or int(MEMORY.read_text().split()[1]) > MOST_PAGES:
        from natcoord_jax.xla.effort import forget

        jax.clear_caches()
        forget()
        gc.collect()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:  # (of glibc)
            trim(0)


@pytest.fixture
def programs():
    """Programs that are compiled."""
    found = []

    def count(name, seconds, **given):
        if name.endswith("backend_compile_duration"):
            found.append(given.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(count)
    yield found
    jax.monitoring.unregister_event_duration_listener(count)
