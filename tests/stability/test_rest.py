"""Stiff parts at rest, in motions of next to no size, and come to rest: nothing there but rounding.

What could go wrong: what rounding makes of a stiff force is large against everything else in the equations,
is taken for a step that is not solved, and the step is refused, halved and refused again.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

RUBBER, STEEL = (1e7, 1000.0), (2.1e11, 7800.0)
STEPS = 40


@cache
def rod(elements, end, elastic="rubber", **options):
    """A straight rod of a metre in no axis' direction: free, hinged or clamped at its end."""
    modulus, density = {"rubber": RUBBER, "steel": STEEL}[elastic]
    scene = nc.Scene()
    section = nc.CircularSection(radius=0.01, E=modulus, density=density)
    tip = np.array([0.48, 0.6, 0.64])
    beam = scene.add(nc.Beam(section, [(0, 0, 0), tuple(tip)], elements=elements, name="rod", **options))
    if end == "hinged":
        scene.add(nc.Revolute(nc.ground, beam.start, point=(0, 0, 0), axis=(0.8, 0.0, -0.6)))
    elif end == "clamped":
        scene.add(nc.Fixed(nc.ground, beam.start, point=(0, 0, 0)))
    return scene.compile()


@cache
def program(scheme=None):
    """Runs of all systems, states and steps; rounding is what it is with the flags of users."""
    scheme = nc.EnergyMomentum() if scheme is None else scheme

    def run(system, state, dt):
        return nc.simulate(system, state, dt=dt, steps=STEPS, throw=False, scheme=scheme)

    return jax.jit(run)


def assert_run(system, run, where):
    """To its end, no step refused, in few corrections."""
    assert int(run.result) == 0, (where, system.explain(run))
    assert int(run.steps_rejected) == 0, where
    assert int(run.iterations) <= 12 * (len(run.t) - 1), where


SHAPES = [
    pytest.param(10, "hinged", marks=pytest.mark.exhaustive),
    pytest.param(10, "clamped", marks=pytest.mark.exhaustive),
    pytest.param(10, "free", marks=pytest.mark.exhaustive),
    pytest.param(50, "hinged", marks=pytest.mark.exhaustive),
    pytest.param(200, "clamped", marks=pytest.mark.exhaustive),
]


def shaken(state, speed):
    """The state with random speeds [m/s] of all nodes but the first, which is held."""
    points = np.zeros(state.v.shape)
    points[4::4] = speed * np.random.default_rng(1).normal(size=points[4::4].shape)
    return eqx.tree_at(lambda s: s.v, state, jnp.asarray(points))


def assert_stays(simulate, system, state, stiffness, speeds, lengths, places=tol.AT_REST):
    """At rest nothing moves but by rounding, and energy changes by no more than strains that are rounding."""
    for speed in speeds:
        for dt in lengths:
            run = simulate(system, shaken(state, speed), dt)
            where = f"stiffness {stiffness:g}, speed {speed:g}, dt {dt:g}"
            assert_run(system, run, where)
            if speed == 0.0:
                assert float(jnp.max(jnp.abs(run.q - state.q))) <= places, where
            energy, rounded = system.energy(run).total, stiffness**0.5 * places
            allowed = tol.ENERGY * energy[0] + 2.0 * rounded * (energy[0] ** 0.5 + rounded)
            assert float(jnp.max(jnp.abs(energy - energy[0]))) <= allowed, where


@pytest.mark.parametrize("elements, end", SHAPES)
def test_a_rod_at_rest_or_hardly_moving(elements, end):
    """Rubber and steel, steps from 1e-6 to 1e-2 s, at rest and with speeds down to 1e-14 m/s."""
    simulate = program()
    for elastic in ("rubber", "steel"):
        # Of all elements together: each is so many times as stiff as the rod.
        stiffness = {"rubber": RUBBER, "steel": STEEL}[elastic][0] * np.pi * 1e-4 * elements**2
        case = (*rod(elements, end, elastic), stiffness, (0.0, 1e-14, 1e-9, 1e-4))
        assert_stays(simulate, *case, (1e-6, 1e-5, 1e-4, 1e-3, 1e-2))


@pytest.mark.parametrize(
    "scheme",
    [
        pytest.param(nc.EnergyMomentum(order=4), id="fourth", marks=pytest.mark.exhaustive),
        pytest.param(nc.VariationalMidpoint(), id="variational", marks=pytest.mark.exhaustive),
        pytest.param(nc.Dissipative(), id="dissipative", marks=pytest.mark.exhaustive),
    ],
)
def test_other_schemes_at_rest(scheme):
    simulate = program(scheme)
    for elastic in ("rubber", "steel"):
        system, state = rod(10, "hinged", elastic)
        for dt in (1e-6, 1e-4, 1e-2):
            run = simulate(system, state, dt)
            assert_run(system, run, (elastic, dt))
            assert float(jnp.max(jnp.abs(run.q - state.q))) <= tol.AT_REST


def spring(ends, stiffness, length):
    """Linear."""
    return nc.Spring(ends, stiffness=stiffness, length=length)


def quadratic(ends, stiffness, length):
    """A polynomial of the squared length."""
    return nc.QuadraticSpring(ends, stiffness=50.0 * stiffness, length=length)


HARDENING = 1e7  # [N/m]


def law(length):
    """Energy of a hardening spring [J]."""
    return HARDENING * (jnp.cosh(length - 0.1) - 1.0)


def hardening(ends, stiffness, length):
    """Any function of the length."""
    return nc.NonlinearSpring(ends, law=law)


def masses_on_springs(kind, stiffness, pull=0.0):
    """Five masses on springs, end to end, at their rest length or stretched between two walls."""
    scene, last = nc.Scene(), nc.ground
    for i in range(5):
        mass = nc.PointMass(mass=0.1, position=(0.1 * (i + 1), 0.02, 0.0), name=f"mass {i}")
        bead, length = scene.add(mass), 0.1 - pull
        ends = nc.Point(last, (0.1 * i, 0.02, 0)), nc.Point(bead, mass.position)
        scene.add(kind(ends, stiffness, length))
        last = bead
    if pull:
        ends = nc.Point(last, (0.5, 0.02, 0)), nc.Point(nc.ground, (0.6, 0.02, 0))
        scene.add(kind(ends, stiffness, length))
    return scene.compile()


@pytest.mark.parametrize(
    "kind, order, pull",
    [
        pytest.param(spring, 2, 1e-3, marks=pytest.mark.slow),
        pytest.param(spring, 2, 0.0, marks=pytest.mark.exhaustive),
        pytest.param(spring, 4, 0.0, marks=pytest.mark.exhaustive),
        pytest.param(quadratic, 2, 0.0, marks=pytest.mark.exhaustive),
        pytest.param(hardening, 2, 0.0, marks=pytest.mark.exhaustive),
    ],
)
def test_masses_on_springs_at_rest(kind, order, pull):
    """Also between walls, where the forces of neighbours cancel."""
    simulate = program(nc.EnergyMomentum(order=order))
    for stiffness in (HARDENING,) if kind is hardening else (1e2, 1e4, 1e7):
        case = *masses_on_springs(kind, stiffness, pull), stiffness
        assert_stays(simulate, *case, (0.0, 1e-12), (1e-5, 1e-3, 1e-2))


@pytest.mark.exhaustive
def test_a_rod_that_is_hardly_driven():
    """Turned with an acceleration of next to nothing, it turns by what is asked for."""
    for acceleration in (1e-12, 1e-4, 1e-2):

        def angle(t, acceleration=acceleration):
            return 0.5 * acceleration * t**2

        scene = nc.Scene()
        section = nc.CircularSection(radius=0.01, E=STEEL[0], density=STEEL[1])
        beam = scene.add(nc.Beam(section, [(0, 0, 0), (1.0, 0, 0)], elements=10, name="rod"))
        hinge = scene.add(nc.Revolute(nc.ground, beam.start, point=(0, 0, 0), axis=(0, 0, 1), name="hinge"))
        scene.add(nc.Drive(hinge, function=angle))
        system, state = scene.compile()
        for dt in (1e-4, 1e-3, 1e-2):
            run = nc.simulate(system, state, dt=dt, steps=STEPS, throw=False)
            assert_run(system, run, f"acceleration {acceleration:g}, dt {dt:g}")
            turned, wanted = float(system.coordinate(run, hinge)[-1]), angle(STEPS * dt)
            assert abs(turned - wanted) <= 1e-9 * wanted + tol.AT_REST


@pytest.mark.exhaustive
def test_a_rod_that_has_come_to_rest():
    """Bent by its weight, in equilibrium: it stays there, with damping, which has nothing to damp."""
    for elastic in (RUBBER, STEEL):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        section = nc.CircularSection(radius=0.01, E=elastic[0], density=elastic[1])
        beam = scene.add(nc.Beam(section, [(0, 0, 0), (0.3, 0, -0.4)], elements=10, damping=1e-3, name="rod"))
        scene.add(nc.Fixed(nc.ground, beam.start, point=(0, 0, 0)))
        system, state = scene.compile()
        rested = nc.equilibrium(system, state).state
        assert float(jnp.max(jnp.abs(rested.q - state.q))) >= 1e-6
        for dt in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2):
            run = program()(system, rested, dt)
            assert_run(system, run, f"dt {dt:g}")
            assert float(jnp.max(jnp.abs(run.q - rested.q))) <= tol.EQUILIBRIUM, dt
