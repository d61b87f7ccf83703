"""Hertz' contact of a sphere of solid elements: force for an approach, and how pressure is spread."""

import numpy as np
import pytest

import natcoord_jax as nc

YOUNG, POISSON = 1.0, 0.3
RADIUS, CONTACT = 100.0, 1.0
"""Of the sphere and of the circle that touches."""
APPROACH = CONTACT**2 / RADIUS
FORCE = 4 / 3 * YOUNG / (1 - POISSON**2) * CONTACT**3 / RADIUS
PRESSURE = 2 * YOUNG / (1 - POISSON**2) * CONTACT / (np.pi * RADIUS)
"""K. L. Johnson, Contact Mechanics (1985), equations (4.22) to (4.24)."""

FINE = np.linspace(0, 1.2 * CONTACT, 6)
LINES = np.concatenate([FINE, FINE[-1] + FINE[1] * np.cumsum(1.6 ** np.arange(1, 8))])
"""Of the mesh: even under the contact, then ever wider apart."""


def far_away(at):
    """Displacement of a half-space z <= 0 that is pushed down at the origin (Boussinesq; Johnson, (3.18))."""
    x, y, depth = at[:, 0], at[:, 1], -at[:, 2]
    r, rho = np.hypot(x, y), np.linalg.norm(at, axis=1)
    size = FORCE * (1 + POISSON) / (2 * np.pi * YOUNG)
    down = size * (depth**2 / rho**3 + 2 * (1 - POISSON) / rho)
    out = size * (r * depth / rho**3 - (1 - 2 * POISSON) * r / (rho * (rho + depth)))
    across = np.divide(out, r, out=np.zeros_like(r), where=r > 0)
    return np.stack([across * x, across * y, -down], axis=1)


def quarter():
    """What of the sphere is near its top: a quarter of a block whose upper face is round."""
    count = len(LINES) - 1
    box = nc.mesh.box((1.0,) * 3, (count,) * 3)
    x, y, height = (
        np.interp(v, np.linspace(0, 1, count + 1), LINES) for v in (*box.nodes.T[:2], 1 - box.nodes[:, 2])
    )
    sag = RADIUS - np.sqrt(RADIUS**2 - x**2 - y**2)
    nodes = np.stack([x, y, -height - sag * (1 - height / LINES[-1])], axis=1)
    return nc.mesh.Mesh(nodes, box.cells, box.sets, box.faces)


@pytest.mark.exhaustive
def test_sphere_of_elements_on_a_plane():
    """Force and pressure to two per cent, where far away the sphere moves as the exact solution has it."""
    scene, mesh = nc.Scene(), quarter()
    material = nc.Elastic(E=YOUNG, nu=POISSON, density=1.0)
    block = scene.add(nc.Solid(mesh, material=material, name="block"))
    places = np.asarray(block.nodes.positions)
    away = np.unique(np.concatenate([mesh.sets[name] for name in ("x1", "y1", "z0")]))
    moved = places[away] + far_away(places[away]) + np.array([0, 0, APPROACH])
    for node, place in zip(away, moved):
        ends = nc.Point(nc.ground, place), nc.Point(block.nodes[int(node)], places[node])
        scene.add(nc.Spring(ends, stiffness=1e3 * YOUNG, length=0.0))
    for name, normal in (("x0", (1, 0, 0)), ("y0", (0, 1, 0))):
        wall = nc.Point(nc.ground), nc.Direction(nc.ground, normal)
        for node in np.setdiff1d(mesh.sets[name], away):
            scene.add(nc.PointOnPlane((*wall, nc.Point(block.nodes[int(node)], places[node]))))
    ceiling = nc.Plane(normal=(0, 0, -1))
    scene.add(nc.Contact(block.face("z1"), ceiling, stiffness=1e3 * YOUNG, name="top"))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=4).state
    top = np.unique(mesh.faces["z1"])
    readings = system.sense(end, tuple(f"top[{k}]" for k in range(len(top))))
    force = np.asarray(readings.force)
    assert 4 * force.sum() == pytest.approx(FORCE, rel=0.02)
    assert np.asarray(readings.gap).min() > -1e-3 * APPROACH
    # Each node has the pressure of what is nearer to it than to others.
    ends = np.concatenate([[0.0], (LINES[1:] + LINES[:-1]) / 2, [LINES[-1]]])
    widths = np.interp(places[top, :2], LINES, np.diff(ends))
    pressure, r = force / widths.prod(axis=1) / PRESSURE, np.hypot(*places[top, :2].T)
    assert pressure[np.argmin(r)] == pytest.approx(1.0, rel=0.02)
    inside, outside = r < 0.6 * CONTACT, r > 1.15 * CONTACT
    np.testing.assert_allclose(pressure[inside], np.sqrt(1 - (r[inside] / CONTACT) ** 2), atol=0.02)
    assert np.all(force[outside] == 0.0)
