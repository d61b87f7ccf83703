"""Loops compiled into one kernel compute what they compute otherwise; what does not fit is left as it is."""

import json
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.native import call
from natcoord_jax.xla import one_kernel, rewriting
from natcoord_jax.xla.one_kernel import as_one_kernel, lane_by_lane

MARK = "xla_cpu_small_call"
MATRIX = np.random.default_rng(1).normal(size=(6, 6))
INDEX = np.array([[4, 0], [1, 1], [0, 5], [1, 1]])
ROWS = np.array([[4, 0, 9], [1, 1, 0], [0, 5, 1], [2, 1, 2], [3, 3, 3], [5, 4, 0]])


def _bits(x):
    """A number of 64 bits that no double holds."""
    large = jnp.array(2**62 + 1)
    return x + jax.lax.fori_loop(0, 2, lambda i, k: k - i, large) % 7


def product_of(equation, one, other):
    """A product of two arrays whose numbers are those of x, as often as they fit."""

    def product(x):
        a, b = (jnp.resize(y, shape) for y, shape in ((x, one), (jnp.cos(x), other)))
        return x + 0.01 * jnp.tanh(jnp.einsum(equation, a, b)).sum()

    return product


def reductions(x):
    """Of lengths that compilers take apart into windows, and of others."""
    for length in (5, 33, 40, 64):
        long = jnp.resize(x, (3, length))
        sums = jnp.sum(long, axis=1), jnp.max(long, axis=1), jnp.min(long, axis=1)
        signs = jnp.all(long > -3.0, axis=1), jnp.any(long > 0.5, axis=1)
        x = x.at[:3, :3].add(0.01 * jnp.stack(sums)).at[3:5, :3].add(0.01 * jnp.stack(signs))
    return x


BODIES = {
    "product": lambda x: jnp.tanh(MATRIX @ x @ MATRIX),
    "batched product": lambda x: jnp.tanh(jnp.einsum("ij,jk,jl->jkl", x, x, x).sum(0)),
    "products with vectors": lambda x: x + 0.1 * jnp.outer(jnp.tanh(x @ x[0]), jnp.tanh(x[1] @ x)),
    "eight terms at a time": product_of("ij,jk->ik", (9, 48), (48, 9)),
    "eight terms at a time and some more": product_of("ij,jk->ik", (7, 13), (13, 11)),
    "more rows than columns": product_of("ij,jk->ik", (11, 13), (13, 7)),
    "few terms": product_of("ij,jk->ik", (25, 5), (5, 25)),
    "term by term": product_of("ij,jk->ik", (30, 30), (30, 30)),
    "over two axes": product_of("buc,kbc->uk", (6, 5, 3), (4, 6, 3)),
    "in lanes": product_of("bij,bju->biu", (4, 20, 17), (4, 17, 9)),
    "to a number": product_of("ij,ij->", (40, 40), (40, 40)),
    "vector of middle length": product_of("ij,j->i", (36, 36), (36,)),
    "reductions": reductions,
    "long sum": lambda x: jnp.tanh(x + jnp.sum(jnp.broadcast_to(x, (200, 6, 6)) * 0.01, axis=0)),
    "update": lambda x: x.at[2, 1].set(0.5).at[1:3].add(x[3:5]),
    "updates at equal places": lambda x: x.at[INDEX[:, 0], INDEX[:, 1]].add(0.1 * x[0, :4]),
    "beyond the end": lambda x: x.at[jnp.array([2, 9])].add(1.0),
    "updates of a batch": lambda x: jax.vmap(lambda x, k: x.at[k].add(0.1 * x[:3]))(x, ROWS),
    "rows": lambda x: x.at[jnp.array([3, 3, 1])].add(0.1 * x[:3]),
    "branch": lambda x: jax.lax.cond(x[0, 0] > 0, lambda x: 0.5 * x, lambda x: x + 1.0, x),
    "integers": _bits,
}


def looped(body, x):
    return jax.lax.fori_loop(0, 3, lambda i, x: body(x), x)


def test_one_kernel_computes_the_same(monkeypatch):
    """Operations of every kind, of one number and of lanes; each is in a kernel, however large it is."""
    monkeypatch.setattr(one_kernel, "WIDE", np.inf)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(6, 6)))
    lanes = x[None] * jnp.linspace(0.5, 1.5, 5)[:, None, None]

    def kernels(x):
        return {name: as_one_kernel(lambda x, f=f: looped(f, x), x) for name, f in BODIES.items()}

    def plainly(x):
        return {name: looped(f, x) for name, f in BODIES.items()}

    one, several = (
        jax.jit(kernels).lower(x),
        jax.jit(jax.vmap(lambda x: lane_by_lane(kernels, x))).lower(lanes),
    )
    assert one.as_text().count(MARK) == several.as_text().count(MARK) == len(BODIES)
    compiled = one.compile()
    machine_code = compiled.runtime_executable().serialize()
    assert re.search(rb"xla_metadata_call[.\d]*_kernel\b", machine_code), "the compiler heeds no mark"
    wanted = jax.jit(jax.vmap(plainly))(jnp.concatenate([x[None], lanes]))
    for name, expected in wanted.items():
        np.testing.assert_allclose(compiled(x)[name], expected[0], rtol=1e-12, atol=1e-12, err_msg=name)
    answers = several.compile()(lanes)
    for name, expected in wanted.items():
        np.testing.assert_allclose(answers[name], expected[1:], rtol=1e-12, atol=1e-12, err_msg=name)


def test_known_indices_cost_no_operation():
    """In loops and branches either: nothing is left of what allows for negative ones, or for some beyond."""
    index, beyond = np.array([3, 0, 5]), np.array([1, 9, 2])

    def body(x):
        return x.at[index].add(x[index - 6]).at[beyond].set(0.5)

    def branched(x):
        return looped(lambda x: jax.lax.cond(x[0] > 0, body, lambda x: -x, x), x)

    x = jnp.linspace(1.0, 2.0, 6)
    flat = rewriting.Flat(jax.make_jaxpr(branched)(x))
    assert not flat.consts
    program = jax.make_jaxpr(flat.rewritten)(x)
    for name in ("select_n", "lt", "min", "and", "scatter"):
        assert f" {name} " not in str(program) and f" {name}[" not in str(program)
    np.testing.assert_allclose(flat.rewritten(x)[0], branched(x), rtol=1e-15)


def test_what_does_not_fit_is_left_as_it_is():
    """What calls a library, and large arrays, which gain nothing by one kernel and compile twice as long."""
    x = jnp.asarray(MATRIX)
    run = jax.jit(lambda x: as_one_kernel(lambda x: looped(jnp.linalg.inv, x), x))
    assert MARK not in run.lower(x).as_text()
    np.testing.assert_allclose(run(x), jnp.linalg.inv(x), rtol=1e-10)
    for size in (8, 40):
        x = jnp.ones((size, size))
        text = jax.jit(lambda x: as_one_kernel(lambda x: jnp.tanh(x @ x), x)).lower(x).as_text()
        assert (MARK in text, "dot_general" in text) == ((True, False) if size == 8 else (False, True))


class Unusual(nc.Force):
    """A force that asks LAPACK, and sorts: neither compiles into one kernel."""

    strength: float = 1.0

    def load(self, x, rates, inputs, t):
        pushed = self.strength * jnp.linalg.solve(MATRIX[:3, :3], -rates[0])
        return nc.Load((jnp.sort(pushed)[::-1][jnp.argsort(jnp.argsort(-pushed))])[None], None)


@pytest.mark.exhaustive
def test_effects_that_call_a_library():
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(1.0, 0.5, 0.2)))
    scene.add(Unusual((nc.Point(body),), strength=0.1))
    trajectory = nc.simulate(*scene.compile(), dt=0.01, steps=20)
    matrix = np.linalg.inv(MATRIX[:3, :3]) * 0.1
    wanted = np.array([1.0, 0.5, 0.2])
    for _ in range(20):
        wanted = np.linalg.solve(np.eye(3) + 0.005 * matrix, (np.eye(3) - 0.005 * matrix) @ wanted)
    np.testing.assert_allclose(trajectory.v[-1, 0], wanted, rtol=1e-12)


class Sorted(nc.Force):
    """A force that sorts, of which the compiler cannot make a part of one kernel."""

    def load(self, x, rates, inputs, t):
        return nc.Load(-jnp.sort(rates), None)


@pytest.mark.exhaustive
def test_goes_on_when_the_compiler_refuses(monkeypatch):
    monkeypatch.setattr(rewriting, "KNOWN", rewriting.KNOWN | {"sort"})
    monkeypatch.setattr(one_kernel, "_refused", [])
    jax.clear_caches()
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(0.2, 0.2, 0.2)))
    scene.add(Sorted((nc.Point(body),)))
    system, state = scene.compile()
    before = nc.set_effort("full")  # with least effort nothing is asked for that might be refused
    with pytest.warns(UserWarning, match="goes on with many"):
        trajectory = nc.simulate(system, state, dt=0.01, steps=20)
    nc.set_effort(before)
    wanted = 0.2 * ((1 - 0.005) / (1 + 0.005)) ** 20
    np.testing.assert_allclose(trajectory.v[-1, 0], wanted, rtol=1e-12)


@pytest.fixture(scope="module", autouse=True)
def by_xla():
    """Machine code of our own comes first elsewhere: these are tests of what there is without it."""
    known, call.available = call.available, lambda: False
    jax.clear_caches()
    yield
    call.available = known
    jax.clear_caches()


# --- scenes ------------------------------------------------------------------------------------------------


def runs_in_one_kernel(name):
    """Whether the program of a few steps of a scene holds a kernel."""
    example = gallery.load(name)
    # Any torques do: those of a problem of control take longer to find than the kernel to compile.
    inputs = (
        example.inputs(4) if example.problem is None else jnp.ones((4, len(example.system.structure.inputs)))
    )
    run = jax.jit(lambda s, x: nc.simulate(s, x, dt=example.dt, steps=4, inputs=inputs))
    return MARK in run.lower(example.system, example.state).as_text()


SMALL = ("spacecraft",)


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(SMALL, marks=pytest.mark.exhaustive),
        pytest.param([n for n in gallery.SCENES if n not in SMALL], marks=pytest.mark.exhaustive),
    ],
    ids=["one", "many"],
)
def test_scenes_run_in_one_kernel(names, monkeypatch):
    """Could go wrong: an operation that is not known to work in one, whereby all is as slow as without."""
    if names is not SMALL:
        monkeypatch.setattr(one_kernel, "WIDE", np.inf)  # those of large arrays, too
    missing = [name for name in names if not runs_in_one_kernel(name)]
    assert not missing


GOLDEN = json.loads(Path(__file__).with_name("golden.json").read_text())


@pytest.mark.exhaustive
def test_a_run_has_as_many_kernels_for_any_number_of_steps():
    """The record of all steps, which grows with them, says nothing about the size of one."""
    example = gallery.load("spacecraft")

    def kernels(steps, derivative):
        def loss(inputs):
            run = nc.simulate(example.system, example.state, dt=example.dt, inputs=inputs)
            return jnp.sum(run.v[-1] ** 2)

        function = jax.grad(loss) if derivative else loss
        return jax.jit(function).lower(example.inputs(steps)).as_text().count(MARK)

    for derivative in (False, True):
        numbers = {steps: kernels(steps, derivative) for steps in (10, 5000, 100_000)}
        assert min(numbers.values()) > 0 and len(set(numbers.values())) == 1, f"kernels by steps: {numbers}"


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", ["heavy_top, 4", "four_bar, 2"])
def test_golden_scenes(case):
    """Values of the file, with kernels, and without them in the test below: so both are the same."""
    name, order = case.split(", ")
    example, scheme = gallery.load(name), nc.EnergyMomentum(order=int(order))
    inputs = example.inputs(20, scheme=scheme)

    def run(v):
        state = eqx.tree_at(lambda s: s.v, example.state, v)
        trajectory = nc.simulate(example.system, state, dt=example.dt, inputs=inputs, scheme=scheme)
        return jnp.sum(trajectory.v[-1] ** 2) + jnp.sum(trajectory.q[-1] ** 2), trajectory

    (_, trajectory), slope = jax.jit(jax.value_and_grad(run, has_aux=True))(example.state.v)
    numbers = {"q": trajectory.q[-1], "v": trajectory.v[-1], "by v": slope}
    for what, bound in (("q", tol.GOLDEN_STATE), ("v", tol.GOLDEN_STATE), ("by v", tol.GOLDEN_GRADIENT)):
        golden = np.array(GOLDEN[case][what])
        distance = np.max(np.abs(np.ravel(numbers[what]) - golden)) / np.max(np.abs(golden))
        assert distance <= bound, what


@pytest.mark.slow
def test_all_goes_on_without_what_is_done_to_programs():
    """The same values with neither kernels nor evaluation by NumPy: only time depends on them."""
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "--plain", "--compile", "quick", "-m", ""]
    test = f"{Path(__file__)}::test_golden_scenes"
    run = subprocess.run([*command, test], capture_output=True, text=True, check=False)
    assert run.returncode == 0 and "2 passed" in run.stdout, run.stdout[-2000:]


@pytest.mark.exhaustive
def test_gradients_of_stiff_and_coarse_steps_are_solved_to_the_end():
    """Factors of other steps serve badly here: the transposed systems need their own."""
    example = gallery.load("open_tree")

    def end(scale):
        state = eqx.tree_at(lambda s: s.v, example.state, scale * example.state.v)
        return jnp.sum(nc.simulate(example.system, state, dt=0.1, steps=12).q[-1] ** 2)

    one = jnp.array(1.0)
    step = 1e-4
    difference = (end(one + step) - end(one - step)) / (2 * step)
    forward = jax.jvp(end, (one,), (one,))[1]
    np.testing.assert_allclose(jax.grad(end)(one), forward, rtol=tol.EXACT_GRADIENT)
    np.testing.assert_allclose(forward, difference, rtol=1e-5)
