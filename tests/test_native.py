"""Machine code of our own: programs drawn by lot give what XLA makes of them, in one lane and in many."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.native import machine
from natcoord_jax.native.build import Built
from natcoord_jax.native.call import Code, native_p
from natcoord_jax.native.driver import driver
from natcoord_jax.native.emit import Emitted
from natcoord_jax.native.program import flattened
from tests.random_programs import Draw, arguments

LANES = 1, 3, 8, 17


def native(function: Any, *like: Any, small: int = 640) -> Any:
    """A function as machine code, whatever its size."""
    closed = jax.make_jaxpr(function)(*like)
    assert not closed.consts
    code = Code(closed, flattened(closed), small)
    code.name((False,) * len(like), None)
    return lambda *args: native_p.bind(
        *map(jnp.asarray, args), code=code, varies=(False,) * len(args), lanes=None
    )


def compare(seed: int, small: int) -> None:
    """One lane, lanes of everything, and lanes that share the matrix."""
    function = Draw(seed)
    x, a, k = arguments(max(LANES), seed)
    own = native(function, x[0], a[0], k[0], small=small)
    alone = jax.jit(function)(x[0], a[0], k[0])
    for found, expected in zip(jax.jit(own)(x[0], a[0], k[0]), alone):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    for axes, given in (((0, 0, 0), a), ((0, None, 0), a[0])):
        expected = jax.jit(jax.vmap(function, axes))(x, given, k)
        batch = jax.jit(jax.vmap(own, axes))
        for lanes in LANES:
            some = given[:lanes] if axes[1] == 0 else given
            found = batch(x[:lanes], some, k[:lanes])
            for one, other in zip(found, expected):
                np.testing.assert_allclose(one, other[:lanes], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("seed", [8])
@pytest.mark.parametrize("small", [pytest.param(640, marks=pytest.mark.exhaustive), 4])
def test_random_programs_are_those_of_xla(seed: int, small: int) -> None:
    compare(seed, small)


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(100, 160))
@pytest.mark.parametrize("small", [640, 12])
def test_many_random_programs_are_those_of_xla(seed: int, small: int) -> None:
    compare(seed, small)


def drawn(lanes: int) -> tuple[Any, Any, Any]:
    """A program, the same as machine code, and its arguments."""
    x, a, k = arguments(lanes, 8)
    return Draw(8), native(Draw(8), x[0], a[0], k[0]), (x, a, k)


def test_results_depend_neither_on_threads_nor_on_the_group() -> None:
    """Bits are the same wherever a lane is."""
    _, own, given = drawn(37)
    batch = jax.jit(jax.vmap(own))
    every = batch(*given)
    order = np.random.default_rng(0).permutation(37)
    before = nc.native_threads(1)
    try:
        alone = batch(*given)
        moved = batch(*(x[order] for x in given))
    finally:
        nc.native_threads(before)
    for x, y, z in zip(every, alone, moved):
        np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(np.asarray(x)[order], z)


@pytest.mark.exhaustive
def test_it_is_an_operation_as_any_other() -> None:
    """Of lanes of lanes, in loops, in what is exported, where nothing of it is left."""
    function, own, (x, a, k) = drawn(3)

    def twice(f: Any) -> Any:
        return jax.jit(jax.vmap(jax.vmap(f, (None, 0, None)), (0, None, 0)))

    def carried(f: Any) -> Any:
        return jax.jit(
            lambda x, a, k: jax.lax.scan(lambda c, _: (tuple(f(*c)), None), (x, a, k), length=2)[0]
        )

    program = export.export(jax.jit(own))(x[0], a[0], k[0])
    assert "natcoord_jax_" not in program.mlir_module()
    pairs = [
        (twice(own)(x, a, k), twice(function)(x, a, k)),
        (carried(own)(x[0], a[0], k[0]), carried(function)(x[0], a[0], k[0])),
        (program.call(x[0], a[0], k[0]), function(x[0], a[0], k[0])),
        (own(x[0], a[0], k[0]), function(x[0], a[0], k[0])),
    ]
    for found, expected in pairs:
        for one, other in zip(found, expected):
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("triple", "cpu", "lanes"),
    [("aarch64-unknown-linux-gnu", "cortex-a72", 2), ("x86_64-unknown-linux-gnu", "haswell", 4),
     ("x86_64-unknown-linux-gnu", "x86-64", 2), ("x86_64-unknown-linux-gnu", "skylake-avx512", 8)],
)  # fmt: skip
def test_other_processors(triple: str, cpu: str, lanes: int) -> None:
    """LLVM finds no fault in the program for them, and makes code of it."""
    llvm = machine.binding()
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    x, a, k = arguments(1, 10)
    program = flattened(jax.make_jaxpr(Draw(10))(x[0], a[0], k[0]))
    built = Built(program)
    emitted = Emitted(built.graph, lanes, [True, False, True])
    module = llvm.parse_assembly(emitted.text + driver(lanes, 3, 3, emitted.work, True))
    module.verify()
    assert len(llvm.Target.from_triple(triple).create_target_machine(cpu=cpu).emit_object(module)) > 1000


@pytest.mark.exhaustive
def test_small_scenes_are_machine_code_whatever_the_number_of_steps() -> None:
    """The record of all steps, which grows with them, says nothing about the size of one."""
    example = gallery.load("spacecraft")

    def codes(steps: int, derivative: bool) -> int:
        def loss(inputs: Any) -> Any:
            return jnp.sum(
                nc.simulate(example.system, example.state, dt=example.dt, inputs=inputs).v[-1] ** 2
            )

        function = jax.grad(loss) if derivative else loss
        return jax.jit(function).lower(example.inputs(steps)).as_text().count("natcoord_jax_")

    for derivative, many in ((False, (10, 400, 20_000)), (True, (20_000,))):
        numbers = {steps: codes(steps, derivative) for steps in many}
        assert set(numbers.values()) == {2 if derivative else 1}, numbers


def test_inputs_by_a_function_are_kept_with_their_derivatives() -> None:
    """What a trajectory has of them is what the function gives at each state, in lanes as well."""
    scene = nc.Scene()
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.2), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, point=(-0.5, 0, 0), axis=(0, 1, 0)))
    scene.add(nc.JointTorque(hinge))
    system, state = scene.compile()
    state = system.with_coordinate(state, hinge, 0.0, rate=1.0)

    def torque(gain: Any, t: Any, state: Any) -> Any:
        return -gain * jnp.tanh(system.rate(state, hinge))[None] + t

    def kept(gain: Any) -> Any:
        run = nc.simulate(system, state, dt=0.01, steps=4, inputs=lambda t, x: torque(gain, t, x))
        given = jax.vmap(lambda x: torque(gain, x.t, x))(jax.tree.map(lambda x: x[:-1], run.states))
        return run.inputs, given

    gains = jnp.array([0.2, 0.5, 0.9])
    directions = jax.jacfwd(lambda gain: jnp.stack(kept(gain)))(gains[0])
    found, expected = jax.vmap(kept)(gains)
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert np.abs(directions[0]).max() > 0.1
    np.testing.assert_allclose(*directions, rtol=1e-11)
