"""Axes of the rates of balls, and bodies that are round about an axis."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.model.axisymmetric_axes import POLE, ball_axes, symmetries

FRAME = np.stack([np.eye(4)] * 2)
AXES = np.array([[0.36, 0.48, 0.8], [0.8, -0.6, 0.0], [0.48, 0.64, -0.6]])
"""Three orthonormal directions."""


def second_moment(values, triad=AXES):
    """With principal values along the rows of a triad."""
    return triad.T @ np.diag(values) @ triad


def found(moment, mass=2.0, arm=(0.0, 0.0, 0.0), point=(0.0, 0.0, 0.0), single=True):
    """Axis of one body by its mass, its first and second moments, and the point of its joint."""
    block = np.zeros((4, 4))
    block[0, 0], block[1:, 1:] = mass, moment
    block[0, 1:] = block[1:, 0] = mass * np.asarray(arm)
    frames = FRAME.copy()
    frames[1, 0, 1:] = point
    rows = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    given = (jnp.asarray(x)[None] for x in (block, frames, rows))
    return np.asarray(symmetries(*given, jnp.array([single])))[0]


@pytest.mark.parametrize("values", [(1.0, 1.0, 3.0), (4.0, 4.0, 0.1), (0.0, 0.0, 2.0), (1.0, 1.0, 0.0)])
def test_the_axis_of_a_round_body_is_found(values):
    """Disks, drums, thin rods and thin plates, whatever directions their directors have."""
    weights = found(second_moment(values))
    assert weights[0] == 0
    np.testing.assert_allclose(np.abs(weights[1:] @ AXES[2]), 1.0, atol=1e-12)
    assert weights[1:] @ POLE >= 0


def test_bodies_that_are_not_round_have_none():
    """Nor has a body that others hang on; a sphere is round about all axes."""
    assert not found(second_moment((1.0, 1.5, 3.0))).any()
    assert not found(second_moment((1.0, 1.0, 3.0)), single=False).any()
    np.testing.assert_array_equal(found(second_moment((2.0, 2.0, 2.0))), [1.0, 0.0, 0.0, 0.0])


def test_the_axis_has_to_pass_through_the_joint():
    """A disk that turns about a point of its axis is round, about one of its rim it is not."""
    moment = second_moment((1.0, 1.0, 0.2))
    along, off = found(moment, point=0.7 * AXES[2]), found(moment, point=0.7 * AXES[0])
    np.testing.assert_allclose(np.abs(along[1:] @ AXES[2]), 1.0, atol=1e-12)
    assert not off.any()


def test_axes_follow_the_axis_and_not_the_spin():
    """They are orthonormal, the third is the axis, and turning about it changes none of them."""
    rng = np.random.default_rng(1)
    weights = jnp.asarray(found(second_moment((1.0, 1.0, 3.0))))[None]
    for _ in range(5):
        triad, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        triad *= np.linalg.det(triad)
        axis = np.asarray(weights)[0, 1:] @ triad
        cross = np.cross(np.eye(3), axis)
        spun = triad @ (np.eye(3) + np.sin(2.0) * cross + (1 - np.cos(2.0)) * cross @ cross)
        first, second = (
            np.asarray(ball_axes(FRAME[None], weights, x[None, None]))[0, 0] for x in (triad, spun)
        )
        np.testing.assert_allclose(first @ first.T, np.eye(3), atol=1e-13)
        np.testing.assert_allclose(first[2], axis, atol=1e-13)
        np.testing.assert_allclose(second, first, atol=1e-13)


def test_opposite_the_pole_axes_are_those_of_the_body():
    """The shortest way there is undetermined."""
    triad = np.stack([[0.8, 0.0, -0.6], np.cross(POLE, [0.8, 0.0, -0.6]), -POLE])
    weights = jnp.array([[0.0, 0.0, 0.0, 1.0]])
    axes = ball_axes(FRAME[None], weights, jnp.asarray(triad)[None, None])
    np.testing.assert_allclose(axes[0, 0], triad, atol=1e-15)
    gradient = jax.grad(lambda d: jnp.sum(ball_axes(FRAME[None], weights, d[None, None])))(jnp.asarray(triad))
    assert np.isfinite(gradient).all()


def spinning(moment, attached=False):
    """A body on a ball joint that spins fast, and its system."""
    scene = nc.Scene()
    moving = dict(position=(0, 0, 0.5), velocity=(-0.15, -0.2, 0.0), angular_velocity=(0.4, -0.3, 60.0))
    body = scene.add(nc.RigidBody(mass=2.0, second_moment=moment, **moving))
    scene.add(nc.Spherical(nc.ground, body, point=(0, 0, 0)))
    scene.add(nc.Gravity(vector=(0.0, 0.0, -9.81)))
    if attached:
        scene.add(nc.Spring((nc.Point(nc.ground, (2, 0, 0)), nc.Point(body, (0.1, 0, 0.5))), stiffness=10.0))
    return scene.compile()


def test_rates_of_a_fast_top_extrapolate():
    """Half a turn a step: along axes of the body a step needs more than twice as many corrections."""
    example = gallery.load("heavy_top")
    system, state = example.system, example.state
    assert np.asarray(system.tree.symmetry).any()
    turning = jax.tree.map(jnp.zeros_like, system.tree.symmetry)
    other = nc.core.effect.replace_fields(
        system, tree=nc.core.effect.replace_fields(system.tree, symmetry=turning)
    )
    scheme = nc.EnergyMomentum(order=8)
    runs = [nc.simulate(s, state, dt=0.005, steps=40, scheme=scheme) for s in (system, other)]
    for run in runs:
        assert int(run.result) == 0
    corrections = [int(run.iterations) for run in runs]
    assert 1.4 * corrections[0] < corrections[1], corrections
    q = [np.asarray(run.states.q[-1]) for run in runs]
    np.testing.assert_allclose(q[0], q[1], atol=1e-9)


def test_what_is_attached_off_the_axis_keeps_axes_of_the_body():
    """A spring on a spinning body goes round along axes that do not."""
    system, _ = spinning((0.1, 0.1, 0.05))
    assert np.asarray(system.tree.symmetry).any()
    assert spinning((0.1, 0.1, 0.05), attached=True)[0].tree.symmetry is None
    assert not np.asarray(spinning((0.1, 0.2, 0.05))[0].tree.symmetry).any()


def test_numbers_may_change_after_compilation():
    """Axes of a body that is no longer round are as good for what the motion is."""
    system, state = spinning((0.1, 0.1, 0.05))
    lumpy, _ = spinning((0.1, 0.16, 0.05))
    changed = nc.core.effect.replace_fields(system, mass=lumpy.mass)
    ends = [nc.simulate(s, state, dt=0.01, steps=20).states.q[-1] for s in (changed, lumpy)]
    np.testing.assert_allclose(*map(np.asarray, ends), atol=1e-11)
