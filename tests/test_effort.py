"""`nc.jit`: the same results as `jax.jit`, with the first of them sooner."""

import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.xla import effort, waiting

OURS = "XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "NATCOORD_JAX_EFFORT"
"""What of the environment is that of the tests."""
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def traces():
    """A function, and how often it has been traced."""
    count = []

    def function(x, factor=2.0):
        count.append(1)
        return jnp.sin(x) * factor

    return function, count


@pytest.fixture
def improved(monkeypatch):
    """Whether each of the programs that full effort was made for has taken over."""
    answer = []

    def take_over(program, again, original=effort.Program._take_over):
        before = program.run
        original(program, again)
        answer.append(program.run is not before)

    monkeypatch.setattr(effort.Program, "_take_over", take_over)
    return answer


def programs_named(name):
    return [p for one in effort._every for p in one.known.values() if p.name == name]


def waited(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def assert_alike(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other)):
        np.testing.assert_allclose(a, b, rtol=tol.EXACT_GRADIENT, atol=tol.EXACT_GRADIENT)


@pytest.mark.parametrize("kind", ["matrices", pytest.param("rollout", marks=pytest.mark.exhaustive)])
def test_full_effort_takes_over_with_the_same_results(kind, improved):
    example = gallery.load("heavy_top")
    x = example.state if kind == "rollout" else jnp.eye(3) + 0.1 * jnp.arange(9.0).reshape(3, 3)

    @partial(nc.jit, effort="tiers")
    def value_and_slope(x):
        def cost(x):
            if kind == "rollout":
                return jnp.sum(nc.simulate(example.system, x, dt=0.01, steps=20).q[-1] ** 2)
            return jnp.sum(jnp.sin(jnp.linalg.inv(x)))

        return jax.value_and_grad(cost)(x)

    first = value_and_slope(x)
    assert not improved
    second = value_and_slope(x)
    assert waited(lambda: value_and_slope(x) and improved), "never compiled with full effort"
    assert improved == [True]
    assert_alike(second, first)
    assert_alike(value_and_slope(x), first)


def test_what_runs_once_is_not_compiled_again(improved):
    function = nc.jit(jnp.sin, effort="tiers")
    function(jnp.array(1.0))
    (program,) = programs_named("sin")
    time.sleep(0.2)
    assert program._again is not None and program._again.answer is None


@pytest.mark.parametrize("one", ["quick", "full"])
def test_one_effort_stays(improved, one):
    function = nc.jit(jnp.sin, effort=one)
    assert [float(function(jnp.array(1.0))) for _ in range(3)] == [np.sin(1.0)] * 3
    assert not waited(lambda: improved, 0.2)


def called_back(x):
    return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), x)


def test_what_no_other_process_can_compile_is_compiled_at_once(improved):
    function = nc.jit(called_back, effort="tiers")
    assert [float(function(0.5)) for _ in range(3)] == [np.sin(0.5)] * 3
    (program,) = programs_named("called_back")
    assert program._again is None and not improved


def test_a_compiler_that_fails_leaves_the_program_at_hand(improved):
    function = nc.jit(jnp.cos, effort="tiers")
    function(0.5)
    (program,) = programs_named("cos")
    program._again.request = b"no program"
    with pytest.warns(UserWarning, match="cos stays compiled with least effort: UnpicklingError"):
        assert waited(lambda: function(0.5) and improved)
    assert improved == [False]
    assert float(function(0.5)) == pytest.approx(np.cos(0.5))


def test_numbers_of_python_and_weak_ones_compile_nothing_new(traces):
    function, count = traces
    compiled = nc.jit(function)
    arguments = [
        1.0,
        jnp.array(1.0),
        np.float64(1.0),
        np.array(1.0),
        jnp.sin(1.0) / jnp.sin(1.0),
        jnp.asarray(1.0) * 1,
    ]
    answer = [compiled(x) for x in arguments] + [compiled(1.0, 2.0), compiled(x=1.0, factor=jnp.array(2.0))]
    np.testing.assert_allclose(answer, 2.0 * np.sin(1.0))
    assert len(count) == 3, "one for each way to pass the arguments"


def test_it_is_transformed_as_others_are(traces):
    function, _ = traces
    compiled, x = nc.jit(function), jnp.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(jax.vmap(compiled)(x), 2.0 * jnp.sin(x))
    np.testing.assert_allclose(jax.vmap(jax.grad(compiled))(x), 2.0 * jnp.cos(x))
    np.testing.assert_allclose(jax.jit(compiled)(x), 2.0 * jnp.sin(x))
    np.testing.assert_allclose(nc.jit(jax.hessian(compiled))(0.5), -2.0 * jnp.sin(0.5))
    np.testing.assert_allclose(jax.grad(lambda y: compiled(1.0, y))(3.0), jnp.sin(1.0))
    closed = jax.grad(lambda y: nc.jit(lambda: y**2)())(3.0)
    assert float(closed) == 6.0, "closed over a number that is being differentiated"


def test_lanes_are_compiled_as_all_else(improved):
    """`jax.vmap` outside of a program: little effort first, and full effort takes over; nested, too."""
    x, y = jnp.linspace(0.0, 1.0, 6).reshape(2, 3), jnp.array(2.0)

    @partial(nc.jit, effort="tiers")
    def function(x, y):
        return {"sum": x + y, "sine": y * jnp.sin(x)}

    for _ in range(3):
        one = jax.vmap(function, in_axes=(1, None))(x, y)
        np.testing.assert_allclose(one["sum"], (x + y).T)
        nested = jax.vmap(jax.vmap(lambda a: function(a, y)["sine"]))(x)
        np.testing.assert_allclose(nested, y * np.sin(x), rtol=1e-14)
        slopes = jax.vmap(jax.grad(lambda a: function(a, y)["sine"]))(x[0])
        np.testing.assert_allclose(slopes, y * np.cos(x[0]), rtol=1e-14)
        of_all = jax.grad(lambda y: jax.vmap(lambda a: function(a, y)["sine"])(x[0]).sum())(y)
        np.testing.assert_allclose(of_all, np.sin(x[0]).sum(), rtol=1e-14)
        np.testing.assert_allclose(jax.jit(jax.vmap(lambda a: function(a, y)["sine"]))(x[0]), nested[0])
    assert waited(lambda: jax.vmap(function, (1, None))(x, y) and improved), "not with full effort"
    mean = nc.jit(lambda a: a - jax.lax.pmean(a, "lanes"))
    np.testing.assert_allclose(jax.vmap(mean, axis_name="lanes")(x[0]), x[0] - x[0].mean(), atol=1e-15)


def test_static_arguments_by_number_and_by_name():
    def power(x, n, *, negative=False):
        assert isinstance(n, int) and isinstance(negative, bool)
        return -(x**n) if negative else x**n

    compiled = nc.jit(power, static_argnums=1, static_argnames="negative")
    assert float(compiled(2.0, 3)) == 8.0
    assert float(compiled(2.0, n=3, negative=True)) == -8.0
    assert float(nc.jit(power, static_argnums=-1)(3.0, 2)) == 9.0
    with pytest.raises(TypeError, match="power: static argument 1 has to be hashable"):
        compiled(2.0, [3])


def test_donated_memory_is_used_again():
    x, y = jnp.arange(4.0), jnp.ones(4)
    compiled = nc.jit(lambda x, y: x + y, donate_argnums=0)
    np.testing.assert_array_equal(compiled(x, y), [1.0, 2.0, 3.0, 4.0])
    assert x.is_deleted() and not y.is_deleted()


def test_leaves_that_are_no_arrays_pass():
    network = eqx.nn.MLP(2, 1, 4, 1, key=jax.random.key(0))
    answer, name = nc.jit(lambda network, x: (network(x), "name"))(network, jnp.ones(2))
    np.testing.assert_allclose(answer, network(jnp.ones(2)))
    assert name == "name"
    slope = nc.jit(eqx.filter_grad(lambda network, x: network(x)[0]))(network, jnp.ones(2))
    assert jax.tree.structure(eqx.filter(slope, eqx.is_array)) is not None


def test_methods_and_options_in_a_decorator():
    class Scaled:
        factor = 3.0

        @nc.jit(effort="quick", static_argnums=0)
        def times(self, x):
            """Documented."""
            return self.factor * x

    assert float(Scaled().times(2.0)) == 6.0
    assert Scaled.times.__doc__ == "Documented."


def test_errors_pass_and_leave_nothing_behind():
    wanted = [True]

    @nc.jit
    def function(x):
        if wanted[0]:
            raise RuntimeError("not now")
        return 2 * x

    with pytest.raises(RuntimeError, match="not now"):
        function(1.0)
    wanted[0] = False
    assert float(function(1.0)) == 2.0


def test_other_efforts_are_refused():
    with pytest.raises(ValueError, match='jit: effort is .none.; pass "tiers", "quick" or "full"'):
        nc.jit(lambda x: x, effort="none")
    with pytest.raises(ValueError, match='set_effort: effort is 3; pass "tiers"'):
        nc.set_effort(3)


def test_the_environment_chooses(monkeypatch):
    monkeypatch.setenv(effort.VARIABLE, "full")
    assert effort._of_environment() == "full"
    monkeypatch.setenv(effort.VARIABLE, "most")
    with pytest.raises(ValueError, match="NATCOORD_JAX_EFFORT in the environment is 'most'; set tiers"):
        effort._of_environment()


def test_settings_of_jax_are_followed():
    function = nc.jit(lambda x: x / (x - 1.0))
    assert np.isinf(function(1.0))
    with jax.debug_nans(True), pytest.raises(FloatingPointError):
        nc.jit(lambda x: x / x)(0.0)
    with jax.disable_jit():
        assert nc.jit(lambda x: x.at[0].set(1.0) if x[0] > 0 else x)(np.array([2.0]))[0] == 1.0


# --- processes --------------------------------------------------------------------------------------------

PROGRAM = """
import os, signal, sys, threading, time
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import natcoord_jax as nc
from natcoord_jax import gallery

example = gallery.load("double_pendulum")
cost = nc.jit(jax.grad(lambda s: jnp.sum(nc.simulate(example.system, s, dt=0.01, steps=5).v[-1] ** 2)))
for _ in range(2):
    found = float(abs(cost(example.state).q).sum())
print(found, flush=True)
"""


def process(more, **env):
    """Run with the compiler that users have, whose full effort takes seconds."""
    plain = {k: v for k, v in os.environ.items() if k not in OURS}
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM + more],
        cwd=ROOT,
        env=plain | env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.exhaustive
def test_an_interpreter_ends_while_full_effort_is_under_way():
    run = process("")
    assert run.stdout is not None
    assert float(run.stdout.readline()) != 0.0
    begun = time.monotonic()
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 0 and not errors, errors
    assert time.monotonic() - begun < 6.0, "it waited for the compiler"


@pytest.mark.exhaustive
def test_an_interrupt_ends_the_run_and_not_the_compiler():
    run = process(
        """
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have it ignored in the background
try:
    print("ready", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    print(float(abs(cost(example.state).q).sum()), flush=True)
"""
    )
    assert run.stdout is not None
    first, ready = run.stdout.readline(), run.stdout.readline()
    assert ready == "ready\n"
    time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    output, errors = run.communicate(timeout=60)
    assert run.returncode == 0 and not errors, errors
    assert float(output) == pytest.approx(float(first), rel=1e-9)


# --- waiting ----------------------------------------------------------------------------------------------


def test_what_takes_long_is_said_on_a_terminal_only(monkeypatch, capfd):
    monkeypatch.setattr(waiting, "PATIENCE", 0.05)
    with waiting.told("slope"):
        time.sleep(0.2)
    assert capfd.readouterr().err == ""
    reader, writer = pty.openpty()
    with os.fdopen(writer, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        with waiting.told("slope"):
            time.sleep(0.2)
        with waiting.told("quick"):
            pass
        print("end", file=terminal, flush=True)
        said = b""
        while b"end" not in said:  # a read may return only a part of what was written
            said += os.read(reader, 1000)
    os.close(reader)
    assert re.match(rb"compiling slope \(the last program took 0\.\d s\) \.\.\. 0\.\d s", said), said
    assert b"quick" not in said
    assert threading.active_count() < 20


# --- programs that last -----------------------------------------------------------------------------------

LASTING = """
import sys, time
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
jnp.arange(3.0) + 1.0  # a program before programs are kept
import natcoord_jax as nc
from natcoord_jax.xla import effort
from natcoord_jax.xla.elsewhere import elsewhere

hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(1) if name.endswith("hits") else None)
nc.keep_programs(sys.argv[1])
function = nc.jit(lambda x: jnp.linalg.inv(jnp.eye(3) * jnp.sin(x) + x)[0, 0], effort="tiers")
found = float(function(0.5))
(program,) = [p for one in effort._every for p in one.known.values()]
least, end = program.run, time.monotonic() + 60
function(0.5)
# here
while program.run is least and time.monotonic() < end:
    function(0.5)
    time.sleep(0.01)
print(found, float(function(0.5)), len(hits), elsewhere._process is None, program.run is not least)
"""


@pytest.fixture
def lasting(tmp_path):
    """Run twice with full effort in a process of its own, with programs kept."""

    def run(more="", check=True):
        answer = subprocess.run(
            [sys.executable, "-c", LASTING.replace("# here", more), str(tmp_path)],
            cwd=ROOT,
            env={k: v for k, v in os.environ.items() if k not in OURS},
            capture_output=True,
            text=True,
        )
        assert not check or answer.returncode == 0, answer.stderr[-2000:]
        return answer

    return run


@pytest.mark.slow
def test_programs_outlast_the_process(lasting, tmp_path):
    first, second = lasting().stdout.split(), lasting().stdout.split()
    assert first[0] == second[0] and first[1] == second[1]
    assert float(first[0]) == pytest.approx(float(first[1]), rel=1e-14)
    assert first[3:] == ["False", "True"]
    assert int(second[2]) > int(first[2]), "nothing of what JAX keeps was found"
    assert second[3:] == ["True", "True"], "full effort was made again"
    assert list(tmp_path.glob("*/full/*"))


@pytest.mark.exhaustive
def test_programs_are_kept_whole_or_not_at_all(lasting, tmp_path):
    """Killed while it works, and with all files cut in half, it compiles again."""
    killed = lasting("time.sleep(0.5); import os, signal; os.kill(os.getpid(), signal.SIGKILL)", check=False)
    assert killed.returncode == -signal.SIGKILL
    assert lasting().stdout.split()[4] == "True"
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    for path in files:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    answer = lasting()
    assert answer.stdout.split()[3:] == ["False", "True"]
    assert "Error reading persistent compilation cache entry" in answer.stderr


# --- fewer programs ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheels():
    example = gallery.load("spacecraft")
    return example, partial(nc.simulate, example.system, example.state, dt=0.02)


@pytest.mark.exhaustive
def test_other_numbers_compile_nothing(wheels, programs):
    """One program serves as long as no more than numbers change, of steps and of inputs, too."""
    example, run = wheels
    torques = np.random.default_rng(0).normal(size=(64, 3))
    run(inputs=torques[:10])
    run(steps=10, inputs=lambda t, state: jnp.sin(t) * jnp.ones(3))
    run(inputs=torques[:10], rtol=1e-4)
    before = len(programs)
    for count in (11, 23, 64):
        assert run(inputs=torques[:count]).q.shape[0] == count + 1
    run(steps=12, inputs=torques[0])
    run(steps=13)
    run(inputs=torques[:10].tolist(), dt=jnp.array(0.01))
    run(inputs=torques[:10], dt=1)
    run(steps=12, inputs=lambda t, state: jnp.sin(t) * jnp.ones(3))
    run(inputs=torques[:12], rtol=1e-5)
    assert programs[before:] == []


@pytest.mark.exhaustive
def test_room_for_more_steps_changes_nothing(wheels):
    example, run = wheels
    torques = jnp.asarray(np.random.default_rng(0).normal(size=(70, 3)))
    within = jax.jit(lambda torques: run(inputs=torques))(torques)
    answer = run(inputs=torques)
    for a, b in zip(jax.tree.leaves(answer), jax.tree.leaves(within), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=tol.EXACT_GRADIENT)


@pytest.mark.exhaustive
@pytest.mark.parametrize("extra", [0, 2])
def test_room_for_more_steps_is_no_room_for_more_attempts(extra):
    example = gallery.load("heavy_top")
    options = dict(dt=500.0, steps=3, extra_substeps=extra, throw=False)
    answer = nc.simulate(example.system, example.state, **options)
    within = jax.jit(lambda state: nc.simulate(example.system, state, **options))(example.state)
    assert int(answer.result) == int(within.result) != 0
    assert int(answer.steps_rejected) == int(within.steps_rejected)
    assert int(answer.failed_step) == int(within.failed_step)
    np.testing.assert_allclose(answer.q, within.q)
