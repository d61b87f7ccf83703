"""Loops compiled into one kernel compute what they compute otherwise; what does not fit is left as it is."""

import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from jaxlib.mlir import ir

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.maths.collocation import _inverse
from natcoord_jax.maths.projectors import range_projector
from natcoord_jax.maths.vectors import cross, skew
from natcoord_jax.stepping import two_kernel_loop
from natcoord_jax.stepping.endpoint import endpoints
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.rollout import run
from natcoord_jax.xla import linear_pair, one_kernel, rewriting
from natcoord_jax.xla.one_kernel import as_one_kernel, in_few_kernels, lane_by_lane

MARK = "xla_cpu_small_call"
MATRIX = np.random.default_rng(1).normal(size=(6, 6))
INDEX = np.array([[4, 0], [1, 1], [0, 5], [1, 1]])
ROWS = np.array([[4, 0, 9], [1, 1, 0], [0, 5, 1], [2, 1, 2], [3, 3, 3], [5, 4, 0]])


def _looped(body):
    return lambda x: jax.lax.fori_loop(0, 3, lambda i, x: body(x), x)


def _bits(x):
    """A number of 64 bits that no double holds."""
    large = jnp.array(2**62 + 1)
    return x + jax.lax.fori_loop(0, 2, lambda i, k: k - i, large) % 7


BODIES = {
    "product": lambda x: jnp.tanh(MATRIX @ x @ MATRIX),
    "batched product": lambda x: jnp.tanh(jnp.einsum("ij,jk,jl->jkl", x, x, x).sum(0)),
    "long sum": lambda x: jnp.tanh(x + jnp.sum(jnp.broadcast_to(x, (200, 6, 6)) * 0.01, axis=0)),
    "update": lambda x: x.at[2, 1].set(0.5).at[1:3].add(x[3:5]),
    "updates at equal places": lambda x: x.at[INDEX[:, 0], INDEX[:, 1]].add(0.1 * x[0, :4]),
    "beyond the end": lambda x: x.at[jnp.array([2, 9])].add(1.0),
    "updates of a batch": lambda x: jax.vmap(lambda x, k: x.at[k].add(0.1 * x[:3]))(x, ROWS),
    "rows": lambda x: x.at[jnp.array([3, 3, 1])].add(0.1 * x[:3]),
    "branch": lambda x: jax.lax.cond(x[0, 0] > 0, lambda x: 0.5 * x, lambda x: x + 1.0, x),
    "projector": lambda x: range_projector(x[:, :3], 2),
    "derivative of a projector": lambda x: jax.grad(lambda x: (range_projector(x[:, :3], 3) * MATRIX).sum())(
        x
    ),
    "integers": _bits,
}


@pytest.fixture
def of_any_width(monkeypatch):
    """Programs of large arrays become kernels as well."""
    monkeypatch.setattr(one_kernel, "WIDE", np.inf)


@pytest.mark.usefixtures("of_any_width")
@pytest.mark.parametrize("name", BODIES)
def test_one_kernel_computes_the_same(name):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(6, 6)))
    plain = _looped(BODIES[name])
    kernel = jax.jit(lambda x: as_one_kernel(plain, x))
    assert MARK in kernel.lower(x).as_text(), "not compiled into one kernel"
    np.testing.assert_allclose(kernel(x), jax.jit(plain)(x), rtol=1e-13, atol=1e-13)
    lanes = x[None] * jnp.linspace(0.5, 1.5, 5)[:, None, None]
    several = jax.jit(jax.vmap(lambda x: lane_by_lane(lambda x: as_one_kernel(plain, x), x)))
    assert MARK in several.lower(lanes).as_text(), "lanes are not compiled into one kernel"
    np.testing.assert_allclose(several(lanes), jax.vmap(plain)(lanes), rtol=1e-13, atol=1e-13)


def test_the_compiler_heeds_the_mark(monkeypatch):
    """What is marked is one function of machine code; without a word, it could be dozens again."""

    def functions(attributes):
        monkeypatch.setattr(one_kernel, "ATTRIBUTES", attributes)
        looped = _looped(BODIES["product"])
        compiled = jax.jit(lambda x: as_one_kernel(looped, x)).lower(jnp.ones((6, 6))).compile()
        code = compiled.runtime_executable().serialize()
        return re.findall(rb"xla_metadata_call[.\d]*_kernel\b", code)

    assert functions(one_kernel.ATTRIBUTES)
    assert not functions({"inlineable": "false"}), "the mark is not what makes one function of it"


@pytest.mark.parametrize("largest", (one_kernel.LARGEST, 0))
def test_parts_are_traced_once_whether_apart_or_not(monkeypatch, largest):
    monkeypatch.setattr(one_kernel, "LARGEST", largest)
    traced = []

    def grown(x):
        traced.append("grown")
        return 1.5 * x

    def shrunk(x):
        traced.append("shrunk")
        return {"x": jnp.sin(x), "times": jnp.array(1)}

    def every(part, x, count):
        def one(carry):
            k, total, x = carry
            found = part(shrunk, part(grown, x))
            return k + found["times"], total + part(grown, found["x"]), found["x"]

        return jax.lax.while_loop(lambda carry: carry[0] < count, one, (0, jnp.zeros_like(x), x))

    x = jnp.arange(1.0, 4.0)
    program = jax.jit(partial(in_few_kernels, every)).lower(x, 3)
    assert sorted(traced) == ["grown", "shrunk"]
    assert program.as_text().count("xla_cpu_small_call") == (1 if largest else 3)
    found = program.compile()(x, 3)
    expected = every(lambda part, *given: part(*given), x, 3)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-14)


def test_what_calls_a_library_is_left_as_it_is():
    x = jnp.asarray(MATRIX)
    run = jax.jit(lambda x: as_one_kernel(_looped(jnp.linalg.inv), x))
    assert MARK not in run.lower(x).as_text()
    np.testing.assert_allclose(run(x), jnp.linalg.inv(x), rtol=1e-10)


class Solved(nc.Force):
    """A force that asks LAPACK."""

    strength: float = 1.0

    def load(self, x, rates, inputs, t):
        return nc.Load(self.strength * jnp.linalg.solve(MATRIX[:3, :3], -rates[0])[None], None)


def test_own_effect_that_calls_a_library():
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(1.0, 0.5, 0.2)))
    scene.add(Solved((nc.Point(body),), strength=0.1))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=20)
    matrix = np.linalg.inv(MATRIX[:3, :3]) * 0.1
    wanted = np.array([1.0, 0.5, 0.2])
    for _ in range(20):
        wanted = np.linalg.solve(np.eye(3) + 0.005 * matrix, (np.eye(3) - 0.005 * matrix) @ wanted)
    np.testing.assert_allclose(trajectory.v[-1, 0], wanted, rtol=1e-12)


class Sorted(nc.Force):
    """A force that sorts, which does not compile into one kernel."""

    def load(self, x, rates, inputs, t):
        return nc.Load(-jnp.sort(rates), None)


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


@pytest.mark.slow
@pytest.mark.parametrize("recorded", [True, pytest.param(False, marks=pytest.mark.exhaustive)])
def test_rounds_of_two_kernels_are_the_loop_in_one(monkeypatch, recorded):
    """Slots, inputs and factors travel between the kernels; more slots than a round has, and substeps."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    carrier, hinges = nc.ground, []
    for k in range(2):
        moving = {"velocity": (0, 0, -k), "angular_velocity": (0, 1, 0)}
        inertia, com = (0.1, 0.2, 0.25), (0.5, 0, 0)
        body = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, com=com, position=(k, 0, 0), **moving))
        hinges.append(scene.add(nc.Revolute(carrier, body, point=(k, 0, 0), axis=(0.0, 1.0, 0.0))))
        carrier = body
    scene.add(nc.JointTorque(hinges[1], name="elbow"))
    system, state = scene.compile(solver="recursive")
    steps = 40
    inputs = 3.0 * np.sin(np.arange(steps))[:, None]
    speeds = jnp.array([1.0, 30.0, 3000.0])
    plan = Plan(steps, 64, 1e-15, None, recorded=recorded)

    def found(parts):
        monkeypatch.setattr(two_kernel_loop, "PARTS", parts)

        def one(speed):
            moving = eqx.tree_at(lambda s: s.v, state, speed * state.v)
            return run(plan, system, moving, jnp.asarray(inputs), jnp.asarray(0.01), None)

        return jax.jit(one)(speeds[0]), jax.jit(jax.vmap(one))(speeds)

    whole, cut = found(1000), found(1)
    assert whole[1][1].course.rejected[2] > 0, "no lane was hard"
    expected = jax.tree.leaves(cut)
    for (path, a), b in zip(jax.tree.leaves_with_path(whole), expected, strict=True):
        # How much corrections leave is measured in roundings, which compilers may choose differently.
        if jax.tree_util.keystr(path).endswith("factors.leaving"):
            np.testing.assert_allclose(a, b, rtol=1e-2)
        else:
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * np.max(np.abs(b), initial=1.0))


@pytest.mark.usefixtures("of_any_width")
@pytest.mark.parametrize("count", [4, 48])
def test_products_of_any_size_stay_in_the_kernel(count):
    a, b = (jax.random.normal(key, (count, 6, 6)) for key in jax.random.split(jax.random.key(0)))

    @jax.jit
    def repeated(a, b):
        return jax.lax.fori_loop(0, 3, lambda _, x: one_kernel.as_one_kernel(lambda a, b: a @ b, x, b), a)

    assert MARK in repeated.lower(a, b).as_text()
    np.testing.assert_allclose(repeated(a, b), a @ b @ b @ b, rtol=1e-12, atol=1e-12)


USUAL = ("spacecraft", "four_bar", "chain")


@pytest.mark.usefixtures("of_any_width")
@pytest.mark.parametrize(
    "product, left, right",
    [
        ("ij,jk->ik", (9, 48), (48, 9)),  # eight terms at a time
        ("ij,jk->ik", (7, 13), (13, 11)),  # and a rest
        ("ij,jk->ik", (11, 13), (13, 7)),  # more rows than columns
        ("ij,jk->ik", (25, 5), (5, 25)),  # fewer terms than are written out
        ("ij,jk->ik", (30, 30), (30, 30)),  # too many numbers for a sum: term by term
        ("buc,kbc->uk", (6, 5, 3), (4, 6, 3)),
        ("bij,bju->biu", (4, 20, 17), (4, 17, 9)),
        ("ij,ij->", (40, 40), (40, 40)),
    ],
)
def test_long_products_are_summed_piece_by_piece(product, left, right):
    rng = np.random.default_rng(3)
    a, b = (jnp.asarray(rng.normal(size=shape)) for shape in (left, right))
    program = jax.jit(lambda a, b: as_one_kernel(lambda a, b: jnp.einsum(product, a, b), a, b))
    assert MARK in program.lower(a, b).as_text() and "dot_general" not in program.lower(a, b).as_text()
    np.testing.assert_allclose(program(a, b), np.einsum(product, a, b), rtol=0, atol=1e-13)
    # Sums number by number take several times as long (seen: 5 to 11 times).
    written = rewriting.Flat(jax.make_jaxpr(lambda a, b: jnp.einsum(product, a, b))(a, b)).rewritten
    loops = str(jax.make_jaxpr(written)(a, b)).count(" = scan[")
    assert loops == (0 if product == "ij,ij->" else 1)


@pytest.mark.usefixtures("of_any_width")
@pytest.mark.parametrize("length", [33, 40, 64])
@pytest.mark.parametrize("reduction", [jnp.sum, jnp.max, jnp.min, jnp.all, jnp.any])
def test_reductions_of_middle_length_stay_whole_for_the_compiler(length, reduction):
    """It would take them apart into windows, which do not fuse and take several times as long."""
    x = jnp.asarray(np.random.default_rng(4).normal(size=(3, length)))

    def reduced(x):
        return reduction(x > -3.0 if reduction in (jnp.all, jnp.any) else x, axis=1)

    program = jax.jit(lambda x: as_one_kernel(reduced, x)).lower(x)
    np.testing.assert_allclose(jax.jit(lambda x: as_one_kernel(reduced, x))(x), reduced(x), rtol=1e-14)
    assert MARK in program.as_text() and "reduce-window" not in program.compile().as_text()


@pytest.mark.usefixtures("of_any_width")
@pytest.mark.parametrize("length", [25, 36, 60])
def test_products_with_vectors_of_middle_length(length):
    rng = np.random.default_rng(5)
    a, x = jnp.asarray(rng.normal(size=(length, length))), jnp.asarray(rng.normal(size=length))
    program = jax.jit(lambda a, x: as_one_kernel(lambda a, x: (a @ x, x @ a), a, x))
    found = program(a, x)
    np.testing.assert_allclose(found[0], np.asarray(a) @ np.asarray(x), atol=1e-13)
    np.testing.assert_allclose(found[1], np.asarray(x) @ np.asarray(a), atol=1e-13)
    assert "reduce-window" not in program.lower(a, x).compile().as_text()


def _marked(name):
    mark = pytest.mark.exhaustive if name == "tennis" else pytest.mark.slow
    return name if name in USUAL else pytest.param(name, marks=mark)


@pytest.mark.usefixtures("of_any_width")
@pytest.mark.parametrize("name", [_marked(name) for name in gallery.SCENES])
def test_every_scene_of_the_gallery_runs_in_one_kernel(name):
    example = gallery.load(name)
    # Any torques do: those of a problem of control take longer to find than the kernel to compile.
    inputs = (
        example.inputs(4) if example.problem is None else jnp.ones((4, len(example.system.structure.inputs)))
    )
    run = jax.jit(lambda s, x: nc.simulate(s, x, dt=example.dt, steps=4, inputs=inputs))
    assert MARK in run.lower(example.system, example.state).as_text()


@pytest.mark.parametrize("size", [8, 40])
def test_programs_of_large_arrays_are_left_as_they_are(size):
    """They gain nothing by one kernel, which takes twice as long to compile."""
    x = jnp.ones((size, size))
    text = jax.jit(lambda x: as_one_kernel(lambda x: jnp.tanh(x @ x), x)).lower(x).as_text()
    assert (MARK in text, "dot_general" in text) == ((True, False) if size == 8 else (False, True))


@pytest.mark.parametrize("name", ["heavy_top", "spacecraft", "four_bar"])
def test_the_end_of_a_run_is_one_kernel_and_little_else(name):
    """Every operation outside takes as long as an evaluation of the equations of a small system."""
    example = gallery.load(name)
    end = endpoints(example.system, example.state, inputs=example.torques, scheme=nc.EnergyMomentum(order=4))
    end(1e-3, 4)  # What the inputs read is seen in the first call.
    (program,) = jax.make_jaxpr(end)(1e-3, 4).eqns
    names = [equation.primitive.name for equation in program.params["jaxpr"].eqns]
    assert names == ["custom_vmap_call"]
    assert MARK in jax.jit(end).lower(1e-3, 4).as_text(), "not compiled into one kernel"


def test_the_end_of_a_run_is_found_by_parts_of_steps_where_whole_ones_fail():
    example = gallery.load("four_bar")
    end = endpoints(example.system, example.state, scheme=nc.EnergyMomentum())(0.2, 10)
    assert int(end.result) == 0 and int(end.substeps) > 10


BUDGETS = {
    ("heavy_top", 2): (2200, 4600),
    ("spacecraft", 2): (2800, 6600),
    ("four_bar", 2): (4100, 9400),
    ("open_tree", 2): (5900, 20500),
    ("rope", 2): (13600, 35500),
    ("spacecraft", 6): (9100, 23000),
}
"""Operations of a value and of a gradient by scene and order: they are what compiling takes time for."""


def operations_of(lowered):
    """Operations of a lowered program, but for constants and what holds others."""
    found = []

    def seen(operation):
        found.append(operation.name)
        return ir.WalkResult.ADVANCE

    lowered.compiler_ir().operation.walk(seen)
    return sum(name.startswith("stablehlo.") for name in found) - found.count("stablehlo.constant")


@pytest.mark.parametrize(
    "scene, order",
    [pytest.param(*k, marks=pytest.mark.slow if v[1] > 1e4 else ()) for k, v in BUDGETS.items()],
)
def test_programs_grow_no_larger(scene, order):
    example, scheme = gallery.load(scene), nc.EnergyMomentum(order=order)

    def cost(state):
        given = dict(dt=example.dt, steps=10, inputs=example.inputs(10), scheme=scheme)
        return jnp.sum(nc.simulate(example.system, state, **given).v[-1] ** 2)

    found = [operations_of(jax.jit(f).lower(example.state)) for f in (cost, jax.value_and_grad(cost))]
    for count, budget in zip(found, BUDGETS[scene, order], strict=True):
        assert 0.85 * budget <= count <= budget, found


def _scaled(residuals, x):
    """x -> sin(a) x, and its sum with weights a."""
    (a,) = residuals
    return jnp.sin(a) * x, jnp.sum(a * x)


class Scaled(linear_pair.LinearWithTranspose):
    """The same with its transpose; neither is differentiated, nor could it be."""

    def forward(self, residuals, arguments):
        return jax.lax.while_loop(lambda x: False, lambda x: x, _scaled(residuals, arguments))

    def backward(self, residuals, cotangents):
        (a,) = residuals
        found = jnp.sin(a) * cotangents[0] + a * cotangents[1]
        return jax.lax.while_loop(lambda x: False, lambda x: x, found)

    def forward_changed(self, residuals, changes, arguments, arguments_dot):
        found = linear_pair.apply(self, residuals, arguments, _scaled(residuals, arguments))
        moved = linear_pair.apply(self, residuals, arguments_dot, found)
        more = linear_pair.along(lambda a: _scaled(a, arguments), (residuals,), (changes,))[1]
        return found, jax.tree.map(jnp.add, moved, more)

    def backward_changed(self, residuals, changes, cotangents, cotangents_dot):
        (a,) = residuals
        found = linear_pair.transposed(self, residuals, cotangents, a)
        moved = linear_pair.transposed(self, residuals, cotangents_dot, a)
        pulled = partial(jax.vjp, lambda x, a: _scaled((a,), x), a)
        more = linear_pair.along(lambda a: pulled(a)[1](cotangents)[0], (a,), changes)[1]
        return found, moved + more


def test_components_go_back_together():
    # Those of slices would be padded and added up, one by one: 600 operations more for the spacecraft.
    a, b, x = jnp.ones((4, 3)), jnp.full((5, 4, 3), 2.0), jnp.ones((4, 3, 3))
    for function, *given in ((cross, a, b), (skew, a), (_inverse, x)):
        value, pull = jax.vjp(function, *given)
        text = str(jax.make_jaxpr(pull)(value))
        assert "stack" in text and "pad[" not in text, f"{function.__name__} goes back by padding"


def test_linear_pair_in_every_mode():
    a, x = jnp.array([0.3, 0.7, 1.1]), jnp.array([1.0, -2.0, 0.5])
    shapes = jax.eval_shape(_scaled, (a,), x)

    def paired(a, x):
        return linear_pair.apply(Scaled(), (a,), x, shapes)

    def plain(a, x):
        return _scaled((a,), x)

    def loss(f):
        def value(a, x):
            vector, number = f(a, x)
            return jnp.sum(vector**3) + number**2

        return value

    for make in (
        lambda f: f(a, x),
        lambda f: jax.grad(loss(f), argnums=(0, 1))(a, x),
        lambda f: jax.hessian(loss(f), argnums=(0, 1))(a, x),
        lambda f: jax.jacrev(jax.jacrev(loss(f)))(a, x),
        lambda f: jax.jacfwd(jax.hessian(loss(f), argnums=(0, 1)))(a, x),
        lambda f: jax.jit(jax.vmap(jax.grad(loss(f), argnums=(0, 1)), in_axes=(None, 0)))(
            a, jnp.stack([x, 2 * x])
        ),
        lambda f: jax.vmap(jax.grad(loss(f), argnums=(0, 1)), in_axes=(0, None))(jnp.stack([a, 2 * a]), x),
    ):
        found, wanted = make(paired), make(plain)
        assert eqx.tree_equal(found, wanted, rtol=1e-12, atol=1e-12), (found, wanted)


class Told(Scaled):
    """Tells of how many arguments at once it is asked."""

    asked: list[int] = []

    def forward_many(self, residuals, arguments):
        self.asked.append(arguments.shape[0])
        return super().forward_many(residuals, arguments)


def test_linear_pair_of_several_arguments():
    """Those that share their residuals are asked for together, in lanes, too; others one by one."""
    a, x = jnp.array([[0.3, 0.7, 1.1], [0.2, 0.5, 0.9]]), jnp.arange(1.0, 13.0).reshape(4, 3)
    shapes = jax.eval_shape(_scaled, (a[0],), x[0])

    def paired(a, x):
        return linear_pair.apply(Told(), (a,), x, shapes)

    def of_all(f):
        return jax.vmap(f, in_axes=(None, 0))

    def asked_by(make):
        Told.asked.clear()
        found, wanted = make(paired), make(lambda a, x: _scaled((a,), x))
        assert eqx.tree_equal(found, wanted, rtol=1e-12, atol=1e-12), (found, wanted)
        return Told.asked

    assert asked_by(lambda f: of_all(f)(a[0], x)) == [4]
    assert asked_by(lambda f: jax.vmap(f)(a, x[:2])) == []
    assert asked_by(lambda f: jax.vmap(of_all(f), in_axes=(0, None))(a, x)) == [4]
    assert asked_by(lambda f: jax.vmap(jax.vmap(f), in_axes=(None, 0))(a, x.reshape(2, 2, 3))) == [2]
    assert asked_by(
        lambda f: jax.vmap(jax.vmap(f), in_axes=(None, 1), out_axes=1)(a, x.reshape(2, 2, 3))
    ) == [2]
    assert asked_by(lambda f: of_all(of_all(f))(a[0], x.reshape(2, 2, 3))) == [2]
    assert asked_by(lambda f: jax.jacfwd(lambda x: f(a[0], x))(x[0])) == [3]


@pytest.mark.slow
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


@pytest.mark.slow
def test_all_goes_on_without_what_is_done_to_programs():
    """A choice of tests passes with neither kernels nor evaluation by NumPy: only time depends on them."""
    chosen = "(hung_pair and revolute and tree) or (free_pair and screw and tree) or a_rod"
    files = [str(Path(__file__).with_name(name)) for name in ("test_conservation.py", "test_constraints.py")]
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "--plain", *files, "-k", chosen]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0 and "3 passed" in run.stdout, run.stdout[-2000:]
