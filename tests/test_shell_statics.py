"""Published statics of cylinders that are pulled out, pinched and snapped: cases of Sze, Liu and Lo.

Finite Elem. Anal. Des. 40 (2004) 1551-1569. An eighth or a quarter of each by symmetry.
"""

import numpy as np
import pytest
from test_shells import grid, hold, mirror, place_of, push

import natcoord_jax as nc

pytestmark = pytest.mark.exhaustive


def cylinder(counts, radius, length, material, thickness):
    """From the middle (left) to the end (right), from the loaded line (bottom) a quarter round (top)."""

    def place(u, v):
        turn = np.pi / 2 * v
        return radius * np.cos(turn), radius * np.sin(turn), length * u

    mesh = grid(counts, place)
    # Turned so that directors point outwards.
    mesh = nc.mesh.Mesh(mesh.nodes, mesh.cells[:, ::-1], mesh.sets)
    directors = mesh.nodes * (1, 1, 0) / radius
    scene = nc.Scene()
    given = {"thickness": thickness, "material": material, "directors": directors}
    return scene, scene.add(nc.Shell(mesh, **given, name="shell")), directors


def eighth(counts, radius, length, material, thickness, load, *, diaphragm=False):
    """The system, its state, and nodes: under the load, and a quarter round in the middle and at the end."""
    scene, shell, directors = cylinder(counts, radius, length / 2, material, thickness)
    end = shell.set("right")
    if diaphragm:
        # On the planes of symmetry one of them is held already.
        hold(scene, end[:-1], 0)
        hold(scene, end[1:], 1)
    mirror(scene, shell.set("left"), directors, 2)
    mirror(scene, shell.set("bottom"), directors, 1)
    mirror(scene, shell.set("top"), directors, 0)
    top = shell.set("top")
    push(scene, shell.set("bottom")[0], (load / 4, 0, 0))
    return *scene.compile(), (shell.set("bottom")[0], top[0], top[-1])


def clamped_half(counts, load=2000.0):
    """Half of a half cylinder, clamped at one end and pushed at the other, with the node under the load."""
    radius, length = 101.6, 304.8
    # The modulus is the one with which the published figures come about; it is printed as 2.0685e7.
    metal = nc.Elastic(E=2068.5, nu=0.3, density=1.0)
    scene, shell, directors = cylinder(counts, radius, length, metal, 3.0)
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    mirror(scene, shell.set("top")[1:], directors, 0)
    # Sides along the ground: neither height nor turns about them.
    mirror(scene, shell.set("bottom")[1:], directors, 1)
    node = shell.set("top")[-1]
    push(scene, node, (0, -load / 2, 0))
    return *scene.compile(), node


def test_cylinder_pulled_out():
    """S05: it snaps from bending to membrane on the way; 2.768, 4.551 and 3.269, missed by 0.8 %."""
    rubber = nc.Elastic(E=10.5e6, nu=0.3125, density=1.0)
    system, state, nodes = eighth((16, 24), 4.953, 10.35, rubber, 0.094, 4e4)
    found = nc.equilibrium(system, state, steps=20)
    moved = [place_of(system, found.states, node) - place_of(system, state, node) for node in nodes]
    moved = np.stack([moved[0][:, 0], -moved[1][:, 1], -moved[2][:, 1]])
    np.testing.assert_allclose(moved[:, -1], (2.7512, 4.5867, 3.2520), atol=1e-3)
    published = {0.1: (1.707, 2.217, 2.293), 0.25: (2.18, 3.087, 3.31), 0.4: (2.376, 3.443, 3.632),
                 0.75: (2.692, 4.423, 3.353), 1.0: (2.768, 4.551, 3.269)}  # fmt: skip
    for load, values in published.items():
        np.testing.assert_allclose(moved[:, round(20 * load) - 1], values, rtol=0.03)


def test_pinched_cylinder():
    """S06: between rigid diaphragms it buckles on the way; 83.102 and 34.272, missed by 0.8 and 3.1 %."""
    foil = nc.Elastic(E=3e4, nu=0.3, density=1.0)
    system, state, nodes = eighth((40, 40), 100.0, 200.0, foil, 1.0, -12e3, diaphragm=True)
    found = nc.equilibrium(system, state, steps=20).states
    moved = [place_of(system, found, node) - place_of(system, state, node) for node in nodes[:2]]
    np.testing.assert_allclose((-moved[0][-1, 0], moved[1][-1, 1]), (83.78, 35.33), atol=0.02)
    for load, value in {0.05: 9.561, 0.1: 23.164, 0.2: 56.373, 0.5: 73.79, 0.7: 78.451, 1.0: 83.102}.items():
        assert -moved[0][round(20 * load) - 1, 0] == pytest.approx(value, rel=0.03)


def test_half_cylinder_pushed_at_its_free_end():
    """S07, isotropic: it snaps; 171.505, missed by 0.5 %.

    By 3.4 % at a tenth of the load, which is the mesh: 8.0 % with 12 x 12, and 4.3 instead of 2 % at 0.2.
    """
    system, state, node = clamped_half((20, 20))
    found = nc.equilibrium(system, state, steps=40)
    sag = place_of(system, state, node)[1] - place_of(system, found.states, node)[:, 1]
    np.testing.assert_allclose(sag[-1], 172.30, atol=0.02)
    published = {0.2: 37.582, 0.4: 113.704, 0.6: 144.185, 0.8: 160.015, 1.0: 171.505}
    for load, value in published.items():
        assert sag[round(40 * load) - 1] == pytest.approx(value, rel=0.03 if load in (0.2, 1.0) else 0.04)
    np.testing.assert_allclose(sag[3] / 16.1, 1.0 - 0.034, atol=1e-3)
