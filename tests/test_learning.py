"""Approximate inverses that learn, and the pseudo-inverse from a projector."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.linsolve.dense import Inverse
from natcoord_jax.linsolve.learning import FORESEEN, across, learnt
from natcoord_jax.maths.projectors import pseudo_inverse, range_projector
from natcoord_jax.stepping import factors, newton
from natcoord_jax.stepping.endpoint import endpoints
from natcoord_jax.stepping.factors import new_factors

YES = np.array(True)


def linear_problem(size, wrong, seed=0):
    """A matrix, a right-hand side, and an inverse that is off by a part of it."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(size) + 0.2 * rng.normal(size=(size, size))
    inverse = np.linalg.inv(matrix) @ (np.eye(size) + wrong * rng.normal(size=(size, size)))
    return jnp.asarray(matrix), jnp.asarray(rng.normal(size=size)), Inverse(jnp.asarray(inverse))


def test_what_was_learnt_holds():
    matrix, right, solver = linear_problem(5, 0.1)
    last = solver.solve(right)
    change = solver.solve(right - matrix @ last)
    weights = jnp.arange(1.0, 6.0)
    better, following, _ = learnt(solver, last, change, weights, YES)
    # The secant condition, and the next correction by the new inverse.
    np.testing.assert_allclose(better.solve(matrix @ last), last, rtol=1e-12)
    np.testing.assert_allclose(better.solve(right - matrix @ last), following, rtol=1e-12)
    # The least change that does it: none where the inverse gives what is orthogonal to the last correction.
    other = np.linalg.solve(np.stack([weights * last, *np.eye(5)[1:]]), np.eye(5)[1])
    assert abs(np.dot(weights * last, other)) < 1e-12
    direction = np.linalg.solve(solver.inverse, other)
    np.testing.assert_allclose(better.solve(direction), other, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_linear_equations_are_solved_in_twice_as_many_steps_as_unknowns(size):
    matrix, right, solver = linear_problem(size, 0.1)
    x, last = jnp.zeros(size), jnp.zeros(size)
    for _ in range(2 * size + 1):
        change = solver.solve(right - matrix @ x)
        solver, change, _ = learnt(solver, last, change, jnp.ones(size), jnp.any(last != 0))
        x, last = x + change, change
    np.testing.assert_allclose(matrix @ x, right, atol=1e-13)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_what_is_known_saves_half_of_them(size):
    """Could go wrong: an update that spoils what was learnt before."""
    matrix, right, solver = linear_problem(size, 0.1)
    weights = jnp.arange(1.0, size + 1.0)
    x, last, news = (jnp.zeros(size),) * 3
    known, steps = jnp.zeros((size, size)), []
    for k in range(size + 1):
        change = solver.solve(right - matrix @ x)
        solver, change, told = learnt(solver, last, change, weights, jnp.array(k > 0), news)
        assert bool(told) == (k > 0)
        known = jnp.concatenate([news[None], known[:-1]]) if told else known
        for step in steps:
            np.testing.assert_allclose(solver.solve(matrix @ step), step, rtol=1e-8, atol=1e-12)
        news = across(known, change, weights)
        np.testing.assert_allclose(known @ (weights * news), 0.0, atol=1e-12)
        x, last = x + change, change
        steps.append(change)
    np.testing.assert_allclose(matrix @ x, right, atol=1e-12)


@pytest.mark.parametrize("case", ["not told", "nothing done", "undone", "not finite"])
def test_nothing_is_learnt_from_what_tells_nothing(case):
    _, right, solver = linear_problem(3, 0.1)
    last = right * (case != "nothing done")
    change = {"undone": -2.0 * FORESEEN * right, "not finite": right * jnp.nan}.get(case, 0.1 * right)
    same, following, told = learnt(solver, last, change, jnp.ones(3), jnp.array(case != "not told"))
    assert not told
    np.testing.assert_array_equal(same.inverse, solver.inverse)
    np.testing.assert_array_equal(following, change)


def test_steps_take_fewer_corrections(monkeypatch):
    example = gallery.load("heavy_top")

    def iterations():
        dt = example.t_end / 800
        # A program of its own each time.
        run = jax.jit(lambda system, state: nc.simulate(system, state, dt=dt, steps=100).iterations)
        return int(run(example.system, example.state))

    learning = iterations()
    monkeypatch.setattr(newton, "LEARNING", np.inf)
    jax.clear_caches()
    without = iterations()
    jax.clear_caches()
    assert learning < 0.85 * without


@pytest.mark.parametrize("least", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("shape", [(9, 6), (5, 7), (4, 4)])
def test_pseudo_inverse_from_a_projector(shape, least):
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(shape[0], 3)) @ np.diag([1.0, 1.0, least]) @ rng.normal(size=(3, shape[1]))
    found = pseudo_inverse(jnp.asarray(matrix), range_projector(jnp.asarray(matrix), 3), 3)
    wanted = np.linalg.pinv(matrix, rcond=1e-9)
    np.testing.assert_allclose(found, wanted, atol=1e-11 * np.abs(wanted).max())


def test_nothing_has_a_pseudo_inverse():
    nothing = jnp.zeros((3, 2))
    np.testing.assert_array_equal(pseudo_inverse(nothing, range_projector(nothing, 1), 1), nothing.T)


def remembering(leaving):
    return replace_fields(new_factors((Inverse(jnp.eye(2)), jnp.ones(2))), leaving=jnp.asarray(leaving))


def test_factors_remember_what_corrections_have_left():
    """Could go wrong: one lucky correction believed for ever, or an error that hides until it is not seen."""
    new, no = remembering(1.0), jnp.array(False)
    # Where nothing is known, the first correction leaves as much as it is, and others not less than is safe.
    assert new.left_by(jnp.asarray(0.0), YES) == 1.0
    np.testing.assert_allclose(new.left_by(jnp.asarray(1e-6), no), 0.02 / 0.98)
    seen = new.having_left(jnp.asarray(1e-6), no)
    assert seen.leaving == 1.0
    seen = new.having_left(jnp.asarray(1e-6), YES)
    np.testing.assert_allclose(seen.left_by(jnp.asarray(0.0), YES), 2e-6, rtol=1e-5)
    np.testing.assert_allclose(seen.left_by(jnp.asarray(1e-7), no), 2e-6, rtol=1e-5)
    # A worse one counts at once, a better one little by little; a ratio that is seen counts in any case.
    worse = seen.having_left(jnp.asarray(1e-3), YES)
    np.testing.assert_allclose(worse.leaving, 1e-3)
    np.testing.assert_allclose(worse.having_left(jnp.asarray(1e-9), YES).leaving, 0.7e-3)
    np.testing.assert_allclose(seen.left_by(jnp.asarray(0.3), no), 0.3 / 0.7)
    # Where no one looks, less is known every time; and nothing at last.
    old = seen
    for _ in range(100):
        old = old.aged()
    assert seen.aged().leaving > seen.leaving and old.leaving == 1.0


@pytest.mark.slow
def test_what_is_remembered_saves_evaluations(monkeypatch):
    """A step that knows its next evaluation to be the last one finds the kick there, and not one later."""
    example = gallery.load("spacecraft")
    # All parts turn about the origin, the centre of the base.
    spin = jnp.cross(jnp.asarray([0.3, -0.2, 0.5]), example.state.q)
    start = replace_fields(example.state, v=spin)

    def corrections():
        jax.clear_caches()
        run = endpoints(example.system, start, inputs=example.torques, scheme=nc.EnergyMomentum(4))
        end = run(5.0 / 100, 100)
        return int(end.iterations), end.state.q

    remembered, q = corrections()
    monkeypatch.setattr(factors, "CAUTION", 1e9)
    forgotten, other = corrections()
    assert remembered < 0.85 * forgotten
    np.testing.assert_allclose(q, other, atol=1e-11)
