"""Kicks that lag behind the unknowns end with the step as those that are found in every evaluation.

Could go wrong: a step that ends with a kick of other stages; kicks extrapolated in axes that rest, or that
are not normal; an iteration that waits for a kick for ever, or takes the jump of a new one for slow
convergence.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.mechanics.frozen_kick import MOST_RENEWALS, SPANS, Lagging, from_body_axes, in_body_axes
from natcoord_jax.mechanics.kick import Kick
from natcoord_jax.mechanics.tangent_space import Velocity
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.newton import begin
from natcoord_jax.stepping.plan import Plan

SCENES = {
    # Trees, loops, and along the chain.
    "open_tree": (4, 2**-7, 30),
    "four_bar": (4, 2**-9, 40),
    "stiff_chain": (4, 2**-7, 20),
}


NOISE = {"open_tree": 3e-14, "four_bar": 3e-14, "stiff_chain": 1e-12}
"""Of the last correction: kicks that serve, and stiff springs, which feel how their ends are rounded."""


@pytest.mark.parametrize(
    "name",
    [
        "four_bar",
        pytest.param("stiff_chain", marks=pytest.mark.exhaustive),
        pytest.param("open_tree", marks=pytest.mark.exhaustive),
    ],
)
def test_steps_obey_the_equations_with_their_own_kick(name):
    order, h, steps = SCENES[name]
    example, tableau = gallery.load(name), nc.EnergyMomentum(order).tableau
    inputs = jnp.zeros((steps, len(example.system.structure.inputs)))
    plan = Plan(steps, 8, 1e-16, None, None, tableau)
    slots, _ = run_slots(plan, example.system, example.state, inputs, jnp.asarray(h))
    states = jax.tree.map(
        lambda first, after: jnp.concatenate([first[None], after[:-1]]), example.state, slots.states
    )

    @jax.jit
    @jax.vmap
    def error(state, y, fraction):
        equations = prepare(example.system, state, inputs[0], fraction * h, tableau)
        found = equations.evaluate(y)
        solver, inertias = equations.factorised(equations.jacobian(y))
        change = jnp.sqrt(jnp.sum(inertias * solver.solve(found.residual) ** 2))
        return change / found.size, jnp.max(jnp.abs(in_body_axes(state, found.kick.exact)))

    errors, kicks = error(states, slots.y, slots.fraction)
    done = np.asarray(slots.accepted)
    assert np.sum(done) >= steps and np.max(np.asarray(kicks)[done]) > 1e-9
    assert np.max(np.asarray(errors)[done]) < NOISE[name]


def a_kick(change, rows=0.0, motion=1.0):
    zero = jnp.asarray(rows) + jnp.zeros((1, 4, 3))
    v = Velocity(zero, jnp.zeros(0))
    return Kick(v, None, None, v, jnp.asarray(change), jnp.asarray(motion))  # pyright: ignore[reportArgumentType]


def iteration(correction=0.0, total=0, last=False, wanting=False):
    it = begin(jnp.zeros(3))
    return it.__class__(
        **{
            **{name: getattr(it, name) for name in it.__dataclass_fields__},
            "correction": jnp.asarray(correction),
            "total": jnp.asarray(total),
            "last": jnp.asarray(last),
            "wanting": jnp.asarray(wanting),
        }
    )


def after(lagging, change, due, correction, first=False):
    it = iteration(total=0 if first else 1)
    return lagging.after(a_kick(change), jnp.array(due), jnp.asarray(correction), it)


def test_a_kick_is_due_where_it_is_what_is_missed_most():
    fresh = Lagging.begin(a_kick(0.0).kick)
    assert fresh.wanted(iteration())
    # The first of the step misses 1e-6; afterwards it answers by a hundredth.
    known = after(fresh, 1e-6, True, 1e-2, first=True)
    assert not known.wanted(iteration(1e-2, 1))
    small = after(known, 0.0, False, 1e-5)
    assert small.wanted(iteration(1e-5, 2, last=True))
    again = after(small, 1e-2 * small.moved, True, 1e-6)
    np.testing.assert_allclose(again.answer, 1e-2)
    assert again.moved == 1e-6 and again.renewals == 2
    assert not again.wanted(iteration(1e-6, 3)) and again.wanted(iteration(2e-8, 4))
    # The next step begins without, since its stages miss more than its kick.
    following = again.beginning(a_kick(0.0).kick)
    assert following.renewals == 0 and not following.wanted(iteration())
    assert not following.wanted(iteration(1e-2, 1)) and following.wanted(iteration(2e-6, 2))


def test_kicks_with_a_strong_answer_are_found_everywhere():
    lagging = after(Lagging.begin(a_kick(0.0).kick), 1.0, True, 1.0)
    strong = after(lagging, 0.5, True, 0.5)
    assert strong.closed == SPANS[0] and strong.wanted(iteration(1.0, 2))
    for k in range(SPANS[0]):
        assert strong.closed == SPANS[0] - k
        strong = strong.beginning(a_kick(0.0).kick)
    assert strong.closed == 0 and strong.span == 2 * SPANS[0]
    weak = lagging
    for _ in range(MOST_RENEWALS - 1):
        assert weak.closed == 0
        weak = after(weak, 1e-3 * weak.moved, True, 1e-3)
    assert weak.closed == SPANS[0]
    # What is nothing but rounding tells nothing.
    noisy = after(Lagging.begin(a_kick(0.0).kick), 1.0, True, 1e-14)
    assert after(noisy, 2e-13, True, 1e-14).closed == 0


def test_an_iteration_that_begins_anew_finds_its_kick_first():
    # Could go wrong: a Jacobian formed with the kick of where corrections led astray, or no kick ever after.
    lost = after(Lagging.begin(a_kick(0.0).kick), 1e-6, True, jnp.nan, first=True)
    waiting = iteration(jnp.nan, 2, wanting=True)
    assert lost.wanted(waiting)
    found = lost.after(a_kick(1e-6, rows=1.0), jnp.array(True), jnp.asarray(jnp.nan), waiting)
    assert np.all(np.asarray(found.held.rows) == 1.0) and found.moved == 0.0


def test_body_axes_there_and_back():
    example = gallery.load("spacecraft")
    rng = np.random.default_rng(0)
    rows = jnp.asarray(rng.normal(size=example.state.q.reshape(-1, 4, 3).shape))
    kick = Velocity(rows, jnp.asarray(rng.normal(size=example.state.rates.shape)))
    numbers = in_body_axes(example.state, kick)
    back = from_body_axes(example.state, numbers)
    np.testing.assert_allclose(back.rows, rows, atol=1e-14)
    np.testing.assert_array_equal(back.rotors, kick.rotors)
    # A turned system has the turned kick, whose components are the same.
    turn = jnp.asarray([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    q = example.state.q.at[:].set(example.state.q @ turn.T)
    turned = example.state.__class__(
        **{**{n: getattr(example.state, n) for n in example.state.__dataclass_fields__}, "q": q}
    )
    np.testing.assert_allclose(
        in_body_axes(turned, Velocity(rows @ turn.T, kick.rotors)), numbers, atol=1e-14
    )
