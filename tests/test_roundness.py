"""Bodies that are round about an axis: their rates are taken along axes that do not spin with them."""

import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc


def top(inertia, attached):
    """A fast top on a ball joint; what is attached off its axis goes round along axes that do not."""
    scene = nc.Scene()
    moving = dict(position=(0, 0, 0.5), velocity=(-0.15, -0.2, 0.0), angular_velocity=(0.4, -0.3, 60.0))
    body = scene.add(nc.RigidBody(mass=2.0, inertia=inertia, **moving, name="top"))
    scene.add(nc.Spherical(nc.ground, body, point=(0, 0, 0)))
    scene.add(nc.Gravity(vector=(0.0, 0.0, -9.81)))
    if attached:
        ends = nc.Point(nc.ground, (2, 0, 0)), nc.Point(body, (0.1, 0, 0.5))
        scene.add(nc.Spring(ends, stiffness=0.0, length=1.0, name="idle"))
    return scene.compile()


def spun(system, state, order=8):
    scheme = nc.EnergyMomentum(order=order)
    return nc.simulate(system, state, dt=0.01, steps=40, scheme=scheme)


DRUM, PLATE = (0.05, 0.05, 0.1), (0.08, 0.02, 0.1)


@pytest.mark.exhaustive
def test_rates_of_a_fast_top_extrapolate():
    """Half a turn a step: along axes of the body a step needs many more corrections, to the same motion.

    An idle spring off the axis has the body keep its own axes.
    """
    runs = [spun(*top(DRUM, attached)) for attached in (False, True)]
    corrections = [int(run.iterations) for run in runs]
    assert 1.4 * corrections[0] < corrections[1], corrections
    ends = [np.asarray(run.q[-1]) for run in runs]
    np.testing.assert_allclose(*ends, atol=1e-9)


@pytest.mark.exhaustive
def test_numbers_may_change_after_compilation():
    """Axes of a body that is no longer round are as good for what the motion is."""
    system, state = top(DRUM, False)
    changed = system.set("top", inertia=np.diag(PLATE))
    runs = [spun(*scene, order=2) for scene in ((changed, state), top(PLATE, False))]
    np.testing.assert_allclose(*(np.asarray(run.q[-1]) for run in runs), atol=tol.SAME_TRAJECTORY)
