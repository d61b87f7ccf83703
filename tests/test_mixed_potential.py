"""Elements with unknowns of their own: as with these eliminated by hand, and exact in what is kept."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1.2, 0), (0.1, 0.2, 0.9), (1.1, 0.9, 0.8)])
CELLS = [(0, 1, 2, 3), (1, 4, 2, 3)]
PAIRS = [(i, j) for i in range(3) for j in range(i, 3)]


class Tetrahedron(nc.Potential):
    """Four points, mu / 2 (tr C - 3) - mu ln J + K / 2 (J - 1)^2, uniform."""

    shear: Any = eqx.field(kw_only=True)
    bulk: Any = eqx.field(kw_only=True)
    reference: Any = eqx.field(default=None, kw_only=True)
    kind = "tetrahedron"

    def assembled_at(self, x):
        """With where it is without stress."""
        return eqx.tree_at(lambda e: e.reference, self, x, is_leaf=lambda x: x is None)

    def invariants(self, x):
        """Right Cauchy-Green tensor."""
        edges, relaxed = (x[1:] - x[0]).T, (self.reference[1:] - self.reference[0]).T
        a, b, c = relaxed.T
        volume = a @ jnp.cross(b, c)
        inverse = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)]) / volume
        f = edges @ inverse
        return jnp.stack([f[:, i] @ f[:, j] for i, j in PAIRS])

    def ratio(self, c):
        """Of volumes."""
        xx, xy, xz, yy, yz, zz = c
        return jnp.sqrt(xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))

    @property
    def volume(self):
        """Without stress."""
        a, b, c = self.reference[1:] - self.reference[0]
        return a @ jnp.cross(b, c) / 6.0

    def shape_energy(self, c):
        """Without that of volumes."""
        return self.volume * self.shear * (0.5 * (c[0] + c[3] + c[5] - 3.0) - jnp.log(self.ratio(c)))

    def energy(self, invariants):
        """Closed form."""
        j = self.ratio(invariants)
        return self.shape_energy(invariants) + 0.5 * self.volume * self.bulk * (j - 1.0) ** 2


class PressureTetrahedron(Tetrahedron, nc.MixedPotential):
    """The same with a pressure of its own and the compliance 1 / K."""

    kind = "tetrahedron with a pressure"
    unknowns = 1
    energy = nc.MixedPotential.energy

    def mixed_energy(self, invariants, unknown):
        """A saddle: stationary where the pressure is K (J - 1)."""
        (pressure,) = unknown
        stretched = pressure * (self.ratio(invariants) - 1.0) - 0.5 * pressure**2 / self.bulk
        return self.shape_energy(invariants) + self.volume * stretched


def two(element, bulk=2e4):
    """Two of them, thrown."""
    scene = nc.Scene()
    spin = np.cross([3.0, -2.0, 4.0], CORNERS) + 3.0 * np.sin(5.0 * CORNERS[:, ::-1])
    nodes = scene.add(nc.Nodes.points(CORNERS, mass=1.0, velocity=spin))
    scene.add(element.on(nodes, CELLS, shear=1e3, bulk=bulk, name="cells"))
    return scene.compile(solver="full")


@pytest.fixture(scope="module")
def runs():
    """Both ways, the same steps."""
    result = {}
    for element in (Tetrahedron, PressureTetrahedron):
        system, state = two(element)
        result[element] = system, nc.simulate(system, state, dt=5e-3, steps=60)
    return result


@pytest.mark.exhaustive
def test_a_pressure_in_an_element_is_that_of_its_volume(runs):
    """The same motion as of the energy with the pressure eliminated by hand, and the sensor shows it."""
    (plain, one), (system, other) = runs[Tetrahedron], runs[PressureTetrahedron]
    np.testing.assert_allclose(other.q, one.q, rtol=0, atol=1e-10)
    shown = system.sense(other, "cells")
    rows = np.asarray(other.q).reshape(-1, 5, 4, 3)[:, :, 0]
    for cell, corners in enumerate(CELLS):
        edges, relaxed = (x[..., corners[1:], :] - x[..., corners[:1], :] for x in (rows, CORNERS))
        ratio = np.linalg.det(edges) / np.linalg.det(relaxed)
        np.testing.assert_allclose(shown.own[:, cell, 0], 2e4 * (ratio - 1.0), rtol=0, atol=1e-7)
    assert float(jnp.ptp(shown.own)) > 100.0
    np.testing.assert_allclose(system.energy(other).potential, plain.energy(one).potential, atol=1e-8)


@pytest.mark.exhaustive
def test_what_it_keeps(runs):
    system, trajectory = runs[PressureTetrahedron]
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SOLID
    turning = np.asarray(system.angular_momentum(trajectory))
    assert np.ptp(turning, axis=0).max() <= tol.MOMENTUM_OF_A_SOLID * np.linalg.norm(turning[0])


@pytest.mark.exhaustive
def test_its_derivatives():
    """Of the end of a run by the bulk modulus, first and second, and beside the closed form."""
    slopes = []
    for element in (Tetrahedron, PressureTetrahedron):
        system, state = two(element)

        def end(bulk, system=system, state=state):
            changed = system.set("cells", bulk=bulk)
            return nc.simulate(changed, state, dt=5e-3, steps=5, throw=False).q[-1, 4, 2]

        slope = jax.jit(jax.grad(end))
        numbers = slope(2e4), jax.jit(jax.jvp, static_argnums=0)(slope, (2e4,), (1.0,))[1]
        slopes.append([float(x) for x in numbers])
        if element is PressureTetrahedron:
            assert_v_shaped(jax.jit(end), jnp.array(2e4), jnp.array(5e3), 5e3 * slope(2e4))
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-7)


class Lost(nc.MixedPotential):
    """An energy that is stationary nowhere."""

    unknowns = 1

    def invariants(self, x):
        """Squared distance."""
        return ((x[1] - x[0]) @ (x[1] - x[0]))[None]

    def mixed_energy(self, invariants, unknown):
        """Always rising."""
        return invariants[0] + jnp.exp(unknown[0])


@pytest.mark.slow
def test_an_energy_that_is_stationary_nowhere_ends_the_run():
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1.0, 0, 0)))
    scene.add(Lost((nc.Point(nc.ground), nc.Point(ball))))
    system, state = scene.compile()
    with pytest.raises(nc.SimulationError):
        nc.simulate(system, state, dt=0.01, steps=3)
