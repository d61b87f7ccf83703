"""Gas in closed surfaces: its volume and forces, balls that are inflated, bounce and pulsate, wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc

RUBBER = nc.Elastic(E=5e6, nu=0.45, density=1100.0)
RADIUS = 0.033


def ball(gas=True, count=3, **numbers):
    """A tennis ball that turns and pulsates, on a coarse mesh."""
    scene, mesh = nc.Scene(), nc.mesh.sphere(RADIUS, count)
    spread = numbers.pop("spread", np.array([120.0, -90.0, 30.0]))
    shell = scene.add(
        nc.Shell(
            mesh,
            thickness=3.5e-3,
            material=RUBBER,
            velocity=mesh.nodes * spread + np.array([3.0, 0, 1]),
            angular_velocity=(150.0, -80.0, 60.0),
            name="ball",
        )
    )
    air = scene.add(nc.Gas(shell, **{"gauge_pressure": 83e3, "name": "air", **numbers})) if gas else None
    return scene, shell, air


@pytest.mark.exhaustive
def test_a_ball_keeps_what_it_has():
    """Energy, momentum and angular momentum, while the gas takes up a part of the energy, by any exponent."""
    system, state = ball(gauge_pressure=0.0)[0].compile()
    for exponent in (1.0, 1.4, 0.0):
        gas = system.set("air", exponent=exponent)
        trajectory = nc.simulate(gas, state, dt=2e-4, steps=40)
        balance = nc.balance(gas, trajectory)
        assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
        assert balance.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
        readings = gas.sense(trajectory, "air")
        assert np.ptp(readings.volume) > 0.03 * float(readings.volume[0])
        if exponent:
            product = (readings.pressure + 101325.0) * readings.volume**exponent
            np.testing.assert_allclose(product, product[0], rtol=1e-12)
            stored = np.asarray(gas.energy(trajectory).stores["air"])
            assert np.ptp(stored) > 1e-3 * float(gas.energy(state).kinetic)
        # Few iterations: the product of the volume's gradient is in the factors.
        assert int(trajectory.iterations) <= 400


def held_ball(count=3, **numbers):
    """At rest, with supports that carry nothing."""
    scene, mesh = nc.Scene(), nc.mesh.sphere(RADIUS, count)
    shell = scene.add(nc.Shell(mesh, thickness=3.5e-3, material=RUBBER, name="ball"))
    air = scene.add(nc.Gas(shell, **{"gauge_pressure": 83e3, "name": "air", **numbers}))
    for place, normals in (
        ((0, 0, -RADIUS), np.eye(3)),
        ((0, 0, RADIUS), np.eye(3)[:2]),
        ((RADIUS, 0, 0), np.eye(3)[1:2]),
    ):
        node = shell.nearest(place)
        place = np.asarray(shell.nodes.positions)[int(node.name.split("[")[1][:-1])]
        for normal in normals:
            plane = nc.Point(nc.ground, place), nc.Direction(nc.ground, normal)
            scene.add(nc.PointOnPlane((*plane, nc.Point(node))))
    return *scene.compile(), shell, air


@pytest.mark.slow
def test_a_ball_is_inflated():
    """From its shape without stress: as thin spheres are stretched, by what the gas has left."""
    system, state, shell, air = held_ball(4, gauge_pressure=2e4)
    inflated = nc.equilibrium(system, state, steps=1)
    assert int(inflated.iterations[0]) <= 8, "Newton's matrix has not all of the gas"
    reading = system.sense(inflated.state, air)
    volume = float(system.get(air, "volume")[0])
    pressure, larger = float(reading.pressure), float(reading.volume) / volume
    assert (pressure + 101325.0) * larger == pytest.approx(2e4 + 101325.0, rel=1e-12)
    # Membrane: p r / 2 h = E / (1 - nu) times the stretch, to first order in it and in h / r.
    stretch = pressure * RADIUS / 2 / 3.5e-3 * (1 - RUBBER.nu) / RUBBER.E
    assert larger ** (1 / 3) - 1 == pytest.approx(stretch, rel=0.1)


@pytest.mark.exhaustive
def test_gradients_with_gas():
    """Of the volume by the pressure in statics, of a place by it in dynamics; V-shaped."""
    system, state, _, air = held_ball(2)
    start = jnp.asarray(2e4)

    def volume(pressure):
        changed = system.set(air, gauge_pressure=pressure)
        return 1e4 * system.sense(nc.equilibrium(changed, state, steps=1).state, air).volume

    volume = jax.jit(volume)
    assert_v_shaped(
        lambda x: volume(x * start), jnp.asarray(1.0), jnp.asarray(1.0), start * jax.grad(volume)(start)
    )
    free, thrown = ball(count=2)[0].compile()

    def place(factor):
        changed = free.set("air", gauge_pressure=factor * start)
        return 1e2 * nc.simulate(changed, thrown, dt=2e-4, steps=15).q[-1, 4, 0]

    place = jax.jit(place)
    assert_v_shaped(place, jnp.asarray(1.0), jnp.asarray(1.0), jax.grad(place)(jnp.asarray(1.0)))


@pytest.mark.exhaustive
def test_a_cavity_of_a_solid_and_a_dissipative_scheme():
    """Faces of a solid enclose a gas as a shell does; numerical damping takes energy, none from the gas."""
    cube = nc.mesh.box((3.0, 3.0, 3.0), (3, 3, 3))
    cells = np.delete(cube.cells, 13, axis=0)
    hollow = nc.mesh.cleaned(cube.nodes, cells, faces={})
    inner = np.isin(hollow.outside, np.flatnonzero(np.all(np.abs(hollow.nodes - 1.5) < 1.0, axis=1))).all(
        axis=1
    )
    named = nc.mesh.Mesh(hollow.nodes, hollow.cells, {}, {"cavity": hollow.outside[inner]})
    assert len(named.faces["cavity"]) == 6
    scene = nc.Scene()
    block = scene.add(nc.Solid(named, material=nc.Elastic(E=1e6, nu=0.3, density=1000.0), name="block"))
    scene.add(nc.Gas(block.face("cavity"), gauge_pressure=5e4, name="air"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=30)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert np.ptp(system.sense(trajectory, "air").volume) > 0.01
    damped = nc.simulate(system, state, dt=5e-3, steps=30, scheme=nc.Dissipative(spectral_radius=0.5))
    total = np.asarray(system.energy(damped).total)
    assert total[-1] < total[0]
    assert nc.balance(system, damped).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    with pytest.raises(ValueError, match="energy-momentum method of order two only"):
        nc.simulate(system, state, dt=5e-3, steps=1, scheme=nc.EnergyMomentum(order=4))
    scene = nc.Scene()
    block = scene.add(nc.Solid(named, material=RUBBER))
    with pytest.raises(ValueError, match="is in several pieces"):
        scene.add(nc.Gas(block, gauge_pressure=1.0))


def shell_of(mesh):
    return nc.Shell(mesh, thickness=1e-3, material=RUBBER)


def test_surfaces_that_enclose_nothing_are_refused():
    scene = nc.Scene()
    tube = scene.add(shell_of(nc.mesh.cylinder(0.1, 0.5, (8, 2))))
    with pytest.raises(ValueError, match="'gas 1'.*'shell 1' is not closed: 16 edges are of one face only"):
        scene.add(nc.Gas(tube, gauge_pressure=1.0))
    sphere = nc.mesh.sphere(0.1, 2)
    cells = sphere.cells.copy()
    cells[0] = cells[0][::-1]
    directors = sphere.nodes
    turned = scene.add(
        nc.Shell(nc.mesh.Mesh(sphere.nodes, cells), thickness=1e-3, material=RUBBER, directors=directors)
    )
    with pytest.raises(ValueError, match="in turn one way and the other"):
        scene.add(nc.Gas(turned, gauge_pressure=1.0))
    ball = scene.add(shell_of(sphere))
    with pytest.raises(ValueError, match="below minus the ambient one"):
        scene.add(nc.Gas(ball, gauge_pressure=-2e5))
