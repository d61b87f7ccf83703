"""Formulas of beam elements for many at once, against differentiation of one element alone."""

import dataclasses
from decimal import Decimal, getcontext
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.gradient import gradient_of
from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.core.potential import Potential, place_markers
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.rotations import arctan_coefficients, from_rotation_vector
from natcoord_jax.mechanics.local import jacobians
from natcoord_jax.mechanics.response import ground_rows, situation

ELEMENTS = 3
STEP = 0.3


def stiffening(strains):
    """A law [J/m] that is added to the linear one."""
    return 40.0 * strains[2] ** 4 + 3.0 * strains[3] ** 2 * strains[4] ** 2 + 5.0 * jnp.cosh(strains[0])


@cache
def compiled(law=None):
    """Elements with arms and rotated frames between bodies, against their numbers too, one on the ground."""
    rng, scene, bodies = np.random.default_rng(3), nc.Scene(), [nc.ground]
    for _ in range(ELEMENTS):
        pose = {
            "position": rng.normal(size=3),
            "orientation": from_rotation_vector(jnp.asarray(rng.normal(size=3))),
        }
        bodies.append(scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 2.5), **pose)))
    for i in range(ELEMENTS):
        pair = (bodies[i], bodies[i + 1]) if i % 2 else (bodies[i + 1], bodies[i])
        root, near = rng.normal(size=(6, 6)), rng.normal(size=3)
        turns = [from_rotation_vector(jnp.asarray(near + 0.3 * rng.normal(size=3))) for _ in pair]
        ends = [nc.Attachment(body, rng.normal(size=3), turn) for body, turn in zip(pair, turns)]
        given = {"length": 0.8 + 0.1 * i, "stiffness": root @ root.T, "reference": 0.1 * rng.normal(size=6)}
        kind = nc.BeamElement if law is None else nc.NonlinearBeamElement
        scene.add(kind(ends, **given, **({} if law is None else {"law": law})))
    return scene.compile(solver="full")


def moving(law, stages):
    """Situation of the elements, rows of their bodies and twists that turn them by a quarter of a radian."""
    system, state = compiled(law)
    (group,) = system.effects
    where = situation(system, group, state, jnp.zeros(0), jnp.asarray(STEP))
    rows = jnp.concatenate([state.rows, ground_rows(state.q)])
    twists = np.random.default_rng(4).normal(size=(len(rows), stages, 6))
    twists[-1] = 0.0
    return group, where, rows[group.bodies], jnp.asarray(twists)[group.bodies]


@pytest.mark.parametrize("law", [pytest.param(None, marks=pytest.mark.slow), stiffening])
def test_gradient_and_curvature_are_derivatives_of_the_energy(law):
    """Of each element alone, and of all at once."""
    effect = compiled(law)[0].effects[0].effect
    invariants = np.random.default_rng(0).normal(size=(ELEMENTS, 7)) * 0.3 + [0, 0, 0, 2.5, 0, 0, 0.9]
    last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), effect)
    together = jnp.asarray(invariants.T)
    slope, curvature = last.slope(together), last.energy_curvature(together)
    energies = last.energy(together)
    assert jnp.max(jnp.abs(slope - gradient_of(last.energy, together))) <= tol.IDENTITY * jnp.max(
        jnp.abs(slope)
    )
    for i, x in enumerate(invariants):
        alone = jax.tree.map(lambda leaf, i=i: leaf[i], effect)
        exact = jax.hessian(alone.energy)(jnp.asarray(x))
        assert jnp.abs(alone.energy(jnp.asarray(x)) - energies[i]) <= tol.IDENTITY * jnp.abs(energies[i])
        for found in (alone.energy_curvature(jnp.asarray(x)), curvature[..., i]):
            assert jnp.max(jnp.abs(found - exact)) <= tol.IDENTITY * jnp.max(jnp.abs(exact))


@pytest.mark.parametrize("stages", [1, 2])
@pytest.mark.parametrize("law", [None, stiffening])
def test_responses_at_once_are_those_of_each(law, stages):
    """Forces and power on bodies of which the element sees attachments with arms and frames of their own."""
    group, where, start, _ = moving(law, stages)
    rng = np.random.default_rng(5)
    rows = jnp.asarray(start + 0.1 * rng.normal(size=(stages, *start.shape)))
    rates, spin = jnp.asarray(rng.normal(size=rows.shape)), jnp.zeros((stages, *start.shape[:2], 3))
    now = StepContext(where.t, where.h, where.inputs, where.coordinates, where.rates, gauss(stages))
    given = where.place, Motion(start, rows, rates, spin), now, jnp.zeros((ELEMENTS, stages, 0))
    found = jax.jit(lambda *x: group.effect.responses(*x))(*given)
    alone = jax.jit(lambda *x: Effect.responses(group.effect, *x))(*given)
    for a, b in ((found.forces, alone.forces), (found.power, alone.power)):
        assert jnp.max(jnp.abs(a - b)) <= tol.IDENTITY * jnp.max(jnp.abs(b))


class Alone(nc.BeamElement):
    """The same element without formulas."""

    together = False
    slope = Potential.slope
    energy_curvature = Potential.energy_curvature
    pulled_back = Potential.pulled_back
    tangents = Effect.tangents

    def linearised(self, place, motion, now, lam):
        """With the gradient of the middle of the step."""
        found = super().linearised(place, motion, now, lam)
        if now.tableau.stages > 1:
            return found
        middle = self.invariants(place_markers(place, motion.start)) + 0.5 * found.steps[0]
        return replace_fields(found, gradient=self.slope(middle)[None])


def alone(effect):
    """The stacked elements, without formulas."""
    made = object.__new__(Alone)
    for field in dataclasses.fields(effect):
        object.__setattr__(made, field.name, getattr(effect, field.name))
    return made


def differentiated(stages, exact):
    """Jacobians of the elements, from formulas and by differentiating each."""
    group, where, start, twists = moving(None, stages)
    plain = replace_fields(group, effect=alone(group.effect))
    rest = where, gauss(stages), start, twists, jnp.zeros((ELEMENTS, stages, 0))
    return [jax.jit(lambda g=g: jacobians(g, *rest, exact=exact)[0][0])() for g in (group, plain)]


@pytest.mark.parametrize("stages", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_tangents_are_derivatives_of_the_linearised_response(stages):
    """Exact in the geometry, for arms, rotated frames and finite turns."""
    found, plain = differentiated(stages, exact=False)
    assert jnp.max(jnp.abs(found - plain)) <= tol.IDENTITY * jnp.max(jnp.abs(plain))


@pytest.mark.parametrize("stages", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_exact_jacobians_at_once_are_those_of_each(stages):
    """As derivatives of trajectories use them."""
    found, plain = differentiated(stages, exact=True)
    assert jnp.max(jnp.abs(found - plain)) <= tol.IDENTITY * jnp.max(jnp.abs(plain))


def test_arc_tangent_coefficients_keep_their_digits():
    """Against sixty digits, from zero to angles of nearly half a turn."""
    getcontext().prec = 60

    def arctan(t):
        halvings = 0
        while t > Decimal("0.05"):
            t, halvings = t / (1 + (1 + t * t).sqrt()), halvings + 1
        terms = [(-1) ** k * t ** (2 * k + 1) / (2 * k + 1) for k in range(30)]
        return 2**halvings * sum(terms)

    for x in (1e-12, 1e-6, 1e-3, 0.02, 0.1, 1.0, 5.0, 1e4):
        square = Decimal(x)
        first = arctan(square.sqrt()) / square.sqrt()
        middle = (1 - first) / square
        expected = first, middle, (Decimal(1) / 3 - middle) / square
        for found, value in zip(arctan_coefficients(jnp.asarray(x)), expected):
            assert abs(Decimal(float(found)) / value - 1) < 1e-15


@pytest.mark.slow
def test_forces_of_elements_that_hardly_move_have_the_right_derivatives():
    """Rounding along a step is no stiffness: what is missing to the energy is nothing but rounding, too.

    Straight elements, where most invariants are zero, of a slender beam: stretch is far stiffer than bending.
    """
    many, length, rng = 4096, 1.0 / 32.0, np.random.default_rng(7)
    ends = tuple(nc.Attachment(nc.ground, place, np.eye(3)) for place in (np.zeros(3), np.ones(3)))
    effect = nc.BeamElement(ends, length=length, stiffness=np.diag([40.0, 40.0, 120.0, 1e-3, 1e-3, 1e-3]))
    effect = replace_fields(effect, markers=None)
    effect = jax.tree.map(lambda x: jnp.asarray(x)[..., None], effect)
    # Each from a fraction of a rounding error to what is far above it.
    straight = jnp.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0, length])[:, None]
    signs = jnp.asarray(rng.choice([-1.0, 1.0], size=(2, 7, many)))
    start = straight + 10.0 ** rng.uniform(-22, -17, size=(7, many)) * signs[0]
    steps = 10.0 ** rng.uniform(-20, -12, size=(1, 7, many)) * signs[1]
    steps = steps.at[:, 3].mul(1e-10)

    def forces(steps):
        return effect.averaged(start, steps, gauss(1))[0]

    units = jnp.broadcast_to(jnp.eye(7)[:, None, :, None], (7, *steps.shape))
    found = jax.vmap(lambda unit: jax.jvp(forces, (steps,), (unit,))[1])(units)
    expected = 0.5 * jnp.swapaxes(effect.energy_curvature(start + 0.5 * steps[0]), 0, 1)
    # Moments of bending are small beside forces of stretch: each by its own.
    sizes = jnp.stack([jnp.abs(expected[i, i]) for i in (0, 1, 2, 0, 4, 5, 6)])
    off = jnp.abs(found - expected) / jnp.sqrt(sizes[:, None] * sizes)
    assert jnp.max(off) <= tol.HARDLY_MOVED
