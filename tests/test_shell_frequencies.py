"""Frequencies of plates and cylinders against exact ones, of order two; statics that forget their path."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_shells import DirectorInPlane, hold

import natcoord_jax as nc

pytestmark = pytest.mark.slow

THIN = 0.005
"""Thickness, by the size."""
METAL = nc.Elastic(E=12e6 * (1 - 0.3**2) / THIN**2, nu=0.3, density=1.0)
"""Frequencies are sqrt(1e6) times those of bending stiffness, mass and side of one."""


def frequencies(shell, held=lambda scene, shell: None, count=12):
    """Of a scene with one shell [rad/s]."""
    scene = nc.Scene()
    held(scene, scene.add(shell))
    return np.asarray(nc.modes(*scene.compile(), count=count, damped=False).frequencies)


def square(count):
    return nc.Shell(nc.mesh.rectangle((1.0, 1.0), (count, count)), thickness=THIN, material=METAL)


def simply_supported(scene, shell):
    """Edges stay where they are, and directors there turn about the edge only."""
    for names, across in ((("left", "right"), 1), (("bottom", "top"), 0)):
        for name in names:
            inner = shell.set(name)[1:-1]
            for component in range(3):
                hold(scene, inner, component)
            axis = nc.Direction(nc.ground, np.eye(3)[across])
            for node in inner:
                scene.add(DirectorInPlane((axis, nc.Direction(node, (0, 0, 1)))))
    corners = shell.nodes.where(lambda x: np.all(np.abs(x[:, :2] - 0.5) > 0.5 - 1e-9, axis=1))
    scene.add(nc.Clamp(nc.ground, corners))


def test_simply_supported_plate():
    """pi^2 (m^2 + n^2): exact for thin plates."""
    exact = np.pi**2 * np.array([2.0, 5.0, 5.0])
    coarse, fine = (frequencies(square(count), simply_supported, 3) / 1e3 / exact - 1 for count in (4, 8))
    assert np.all(np.abs(fine) < 0.01)
    # Masses and stiffnesses err in opposite ways, and for the others one takes over from the other.
    assert np.log2(coarse[0] / fine[0]) == pytest.approx(2.0, abs=0.1)


def test_free_square_plate():
    """13.489, 19.789 and 24.432 by Leissa (J. Sound Vib. 31, 1973); finer series are 0.2 to 1 % below."""
    coarse, fine = (frequencies(square(count)) / 1e3 for count in (4, 8))
    assert np.all(fine[:6] < 1e-3 * fine[6]), "no six rigid motions"
    exact = np.array([13.468, 19.596, 24.270])
    np.testing.assert_allclose(np.log2((coarse[6:9] - exact) / (fine[6:9] - exact)), 2.0, atol=0.3)
    np.testing.assert_allclose((4 * fine[6:9] - coarse[6:9]) / 3, exact, rtol=0.015)


def test_free_ring():
    """n (n^2 - 1) / sqrt(n^2 + 1): a cylinder that bends without being stretched (Rayleigh)."""
    errors, rubber = [], nc.Elastic(E=12e6 / 0.01**2, density=1.0)
    for count in (16, 32):
        shell = nc.Shell(nc.mesh.cylinder(1.0, 1.0, (count, 1)), thickness=0.01, material=rubber)
        found = frequencies(shell)[6:8] / 1e3
        assert found[0] == pytest.approx(found[1], rel=1e-6)
        errors.append(found[0] / (6 / np.sqrt(5)) - 1)
    assert abs(errors[1]) < 0.01
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


def test_equilibria_do_not_depend_on_the_path():
    """A plate bent by one force and then by another, or the other way round, ends in the same place."""
    scene = nc.Scene()
    rubber = nc.Elastic(E=1e6, nu=0.3, density=1.0)
    shell = scene.add(nc.Shell(nc.mesh.rectangle((1.0, 0.5), (4, 2)), thickness=0.02, material=rubber))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    edge = shell.set("right")
    for k, axis in ((0, (0, 0, 1)), (2, (0, 0.5, -1))):
        scene.add(nc.BodyForceInput((nc.Point(edge[k]), nc.Direction(nc.ground, axis))))
    system, state = scene.compile()
    ways = np.array([[(1, 0), (2, 0), (2, 1), (2, 2)], [(0, 1), (0, 2), (1, 2), (2, 2)]], float)
    found = [nc.equilibrium(system, state, jnp.arange(4.0), inputs=0.1 * way).state.q for way in ways]
    # Places and directors; the other axes of a node mean nothing.
    ends = [np.asarray(q).reshape(-1, 4, 3)[:, :2] for q in found]
    np.testing.assert_allclose(*ends, atol=1e-9)
    assert np.abs(found[0] - state.q).max() > 0.02
