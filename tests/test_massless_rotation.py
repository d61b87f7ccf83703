"""Nodes of a beam without rotary inertia: they turn as their torques ask, at once."""

import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

SOLVERS = ("full", "reduced", "recursive")


def thread(solver):
    """A cantilever whose section has mass and no rotary inertia, under its weight."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=2.0, GJ=1.0, density=1.0)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, start=nc.ground))
    return *scene.compile(solver=solver), beam


def motion(solver, **options):
    system, state, beam = thread(solver)
    trajectory = nc.simulate(system, state, dt=4e-3, steps=50, **options)
    assert float(np.max(nc.balance(system, trajectory).energy)) < 1e-11
    return np.asarray(system.sense(trajectory, beam.end).position)


@pytest.mark.slow
def test_they_are_no_point_masses():
    """Could go wrong: the form with all multipliers takes them for point masses and holds their directors by
    an inertia of its own, so that the beam hardly bends and energy is lost."""
    paths = [motion(solver) for solver in SOLVERS]
    assert paths[0][-1, 2] < -0.1
    for path in paths[1:]:
        np.testing.assert_allclose(path, paths[0], rtol=0, atol=1e-10)


@pytest.mark.slow
def test_they_are_kept_at_order_four():
    """Could go wrong: stages at which massless directors have no velocity of their own."""
    coarse, fine = motion("reduced"), motion("reduced", scheme=nc.EnergyMomentum(order=4))
    np.testing.assert_allclose(coarse, fine, rtol=0, atol=1e-3)
    assert float(jnp.max(jnp.abs(coarse - fine))) > 1e-7
