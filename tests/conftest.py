"""Settings of the test-suite: double precision, compiler flags by lane, a cache of programs, durations."""

import ctypes
import gc
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
import lanes
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parents[1]
CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(ROOT / ".pytest_cache" / "jax")

QUICK = (
    # Compilers from JAX 0.11 on do not have this, and end a process that asks for it.
    ("--xla_cpu_use_fusion_emitters=false " if version("jaxlib").startswith("0.10.") else "")
    + "--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops,"
    + "while-loop-trip-count-annotator --xla_backend_optimization_level=0"
)
"""Compiler flags of the default lane: a third of the time to compile, for programs that are run briefly."""

MAPS, MEMORY = Path("/proc/self/maps"), Path("/proc/self/statm")
MOST_MAPS, MOST_PAGES = 20_000, 750_000
"""Regions and pages of memory (3 GB) of one process at which its compiled programs are given up.

Every program takes a few hundred regions, of which Linux allows 65 530: a process that runs out of them
crashes in the compiler. What compilers have freed stays with the process until it is asked back.
"""

# Tracing makes millions of small objects that live on: looking through them all takes a tenth of the time.
gc.set_threshold(200_000, 50, 100)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--check-types", action="store_true", help="check shapes and types at run time")
    parser.addoption("--plain", action="store_true", help="without what xla/ does to programs")
    parser.addoption("--write-golden", action="store_true", help="write the file of test_golden.py anew")
    parser.addoption("--hunt-seeds", type=int, help="random numbers of each structure in test_hunt.py")
    parser.addoption(
        "--compile",
        choices=("quick", "user"),
        help="compiler flags: quick, or those of users; by default quick in the default lane only",
    )
    parser.addoption(
        "--write-durations",
        action="store_true",
        help="enter what the tests take in durations.json, with an empty cache of programs",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Choose compiler flags and cache before the first program is compiled, and check types if asked to.

    Checks take a quarter of the time to trace; `test_types.py` makes them for some scenes.
    """
    _set_up_jax(config)
    if config.option.write_durations:
        config.pluginmanager.register(Durations())
    if config.option.check_types:
        hook = install_import_hook("natcoord_jax", "beartype.beartype")
        config.add_cleanup(hook.uninstall)
    if config.option.plain:
        from natcoord_jax.core import eager_numpy
        from natcoord_jax.native import call
        from natcoord_jax.xla import materialise, one_kernel

        one_kernel._attributed = materialise._attributed = None
        call.available = lambda: False
        eager_numpy.at_top_level = lambda *values: False
        eager_numpy.in_program = lambda *values: True


def _set_up_jax(config: pytest.Config) -> None:
    if (config.option.compile or ("quick" if _is_default_lane(config) else "user")) == "quick":
        # Flags from outside come last and win.
        os.environ["XLA_FLAGS"] = f"{QUICK} {os.environ.get('XLA_FLAGS', '')}"
        # With these flags, a second program with full effort would be the first again.
        os.environ.setdefault("NATCOORD_JAX_EFFORT", "quick")
    else:
        os.environ.setdefault("NATCOORD_JAX_EFFORT", "full")
    cache = CACHE
    if config.option.write_durations and not _is_worker(config):
        cache = tempfile.mkdtemp()
        config.add_cleanup(lambda: shutil.rmtree(cache, ignore_errors=True))
        os.environ["JAX_COMPILATION_CACHE_DIR"] = cache
    # Notebooks and command lines run in processes of their own and share the cache through the environment.
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
    # Single operations called from Python are programs, too: 30 ms each to compile, hundreds in a process.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def _is_default_lane(config: pytest.Config) -> bool:
    """Whether the lane of `pytest` without a choice of marks is run."""
    return "not slow" in (config.option.markexpr or "")


def _is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


def pytest_itemcollected(item: pytest.Item) -> None:
    """What is exhaustive for one of its parameters is not slow besides; some tests are in two lanes."""
    if item.get_closest_marker("exhaustive"):
        item.own_markers[:] = [mark for mark in item.own_markers if mark.name != "slow"]
    elif item.get_closest_marker("users") and not _is_default_lane(item.config):
        item.add_marker(pytest.mark.slow)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files that take long come first: the last one would keep a single core busy at the end."""
    seconds = {t: s for tests in lanes.seconds_by_lane().values() for t, s in tests.items()}
    files: dict[str, float] = {}
    for item in items:
        file = item.nodeid.partition("::")[0]
        files[file] = files.get(file, 0.0) + seconds.get(item.nodeid, lanes.UNMEASURED)
    items.sort(key=lambda item: -files[item.nodeid.partition("::")[0]])


# --- durations ----------------------------------------------------------------------------------------------


def _processor_seconds() -> float:
    """Processor time of this process and of the children that have ended: other work does not disturb it."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


class Durations:
    """A plugin that measures tests, those of other folders, too, as a plugin of this folder would not."""

    def __init__(self) -> None:
        self.begun = 0.0
        self.seconds: dict[str, dict[str, float]] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        self.begun = _processor_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo):
        report = yield
        if report.when == "teardown":
            entry = lanes.lane_of(item), round(_processor_seconds() - self.begun, 2)
            report.user_properties = [*report.user_properties, ("duration", entry)]
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        for name, entry in report.user_properties:
            if name == "duration":
                lane, seconds = entry
                self.seconds.setdefault(lane, {})[report.nodeid] = seconds

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if not _is_worker(session.config):
            chosen = session.config.args_source.name == "ARGS" or session.config.option.keyword
            lanes.enter(self.seconds, all_of_lane=not chosen)
            lanes.write()


# --- memory, programs ---------------------------------------------------------------------------------------


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
    names = []

    def count(name, seconds, **properties):
        if name.endswith("backend_compile_duration"):
            names.append(properties.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(count)
    yield names
    jax.monitoring.unregister_event_duration_listener(count)
