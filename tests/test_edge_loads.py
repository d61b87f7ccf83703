"""Forces and moments along the edges of shells: their resultants, rolled and bent strips, wrong input."""

import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

RUBBER = nc.Elastic(E=2e6, density=1000.0)


def strip(count=8, **given):
    """A strip of 1 m x 0.1 m, held at its left end."""
    scene = nc.Scene()
    mesh = nc.mesh.rectangle((1.0, 0.1), (count, 1))
    shell = scene.add(nc.Shell(mesh, thickness=0.01, material=RUBBER, name="strip", **given))
    return scene, shell


def test_edges_of_a_mesh():
    """Sides of one cell only, in turn round it, of quadrilaterals and of triangles."""
    square = nc.mesh.rectangle((1.0, 1.0), (2, 1))
    assert {tuple(x) for x in square.edges.tolist()} == {(0, 2), (2, 4), (4, 5), (5, 3), (3, 1), (1, 0)}
    halves = nc.mesh.Mesh(square.nodes, [(0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3)], square.sets)
    assert {tuple(x) for x in halves.edges.tolist()} == {tuple(x) for x in square.edges.tolist()}
    scene = nc.Scene()
    plate = scene.add(nc.Shell(square, thickness=0.1, material=RUBBER))
    assert plate.edge("right").sides.tolist() == [[4, 5]]


@pytest.mark.parametrize("following", [False, True])
def test_resultant_of_an_edge_load(following):
    """Momentum and angular momentum of a free plate grow as force and moment say; work is energy."""
    scene = nc.Scene()
    mesh = nc.mesh.rectangle((1.0, 0.6), (2, 3))
    plate = scene.add(nc.Shell(mesh, thickness=0.05, material=RUBBER, name="plate"))
    # As seen from the edge x = 1: along y, outwards x, normal z.
    axes = np.array([(0, 1, 0), (1, 0, 0), (0, 0, 1)], float)
    force, moment = np.array([3.0, 40.0, 5.0]), np.array([2.0, 1.0, 0.0])
    given = (force, moment) if following else (force @ axes, moment @ axes)
    edge = plate.edge("right")
    scene.add(nc.EdgeLoad(edge, force=given[0], moment=given[1], following=following, name="push"))
    system, state = scene.compile()
    dt = 1e-4
    trajectory = nc.simulate(system, state, dt=dt, steps=2)
    last = trajectory.states
    resultant = 0.6 * (force @ axes)
    np.testing.assert_allclose(
        system.momentum(last)[-1] / (2 * dt), resultant, rtol=1e-4, atol=0 if following else 1e-9
    )
    turning = np.cross((1.0, 0.3, 0.0), resultant) + 0.6 * (moment @ axes)
    np.testing.assert_allclose(system.angular_momentum(last)[-1] / (2 * dt), turning, rtol=1e-3)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert float(system.work(trajectory)["push"][-1]) > 0


@pytest.mark.slow
def test_a_strip_rolled_by_a_following_moment():
    """Into half a circle: the moment stays normal to it."""
    scene, shell = strip(16)
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    moment = np.pi * float(RUBBER.E) * 0.01**3 / 12
    scene.add(nc.EdgeLoad(shell.edge("right"), moment=lambda t: (-moment * t, 0.0, 0.0), following=True))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=8).state
    tip = system.sense(end, shell.set("right")[0]).position
    # Directors between nodes are shortened, by the square of a 32nd of pi.
    np.testing.assert_allclose((tip[0], tip[2]), (0.0, 2 / np.pi), atol=0.02)


@pytest.mark.slow
def test_a_strip_bends_as_a_beam_under_a_following_force():
    """That keeps its angle to the end, by far another place than that of a dead force."""
    found, load = [], 0.03
    for following in (False, True):
        scene, shell = strip()
        scene.add(nc.Clamp(nc.ground, shell.set("left")))
        push = (0.0, 0.0, 10 * load)
        scene.add(nc.EdgeLoad(shell.edge("right"), force=lambda t, p=push: tuple(t * x for x in p),
                              following=following))  # fmt: skip
        system, state = scene.compile()
        end = nc.equilibrium(system, state, steps=4).state
        found.append(np.asarray(system.sense(end, shell.set("right")[0]).position)[[0, 2]])
        scene = nc.Scene()
        section = nc.RectangularSection(width=0.1, height=0.01, E=float(RUBBER.E), nu=0.0, density=1000.0)
        beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=8, start=nc.ground))
        axes = tuple(nc.Direction(beam.end, axis) for axis in np.eye(3))
        markers = (nc.Point(beam.end), *(axes if following else ()))
        scene.add(nc.PointForce(markers, force=lambda t: (0.0, 0.0, load * t), following=following))
        system, state = scene.compile()
        end = nc.equilibrium(system, state, steps=4).state
        same = np.asarray(system.sense(end, beam.end).position)[[0, 2]]
        np.testing.assert_allclose(found[-1], same, atol=5e-3)
    assert np.linalg.norm(found[1] - found[0]) > 0.05


def test_edge_loads_that_cannot_be():
    scene, shell = strip()
    with pytest.raises(ValueError, match=r"has neither force \[N/m\] nor moment"):
        scene.add(nc.EdgeLoad(shell.edge("right")))
    with pytest.raises(ValueError, match="has 2 N m/m about the directors, which shells do not carry"):
        scene.add(nc.EdgeLoad(shell.edge("right"), moment=(0, 0, 2.0), following=True))
    with pytest.raises(ValueError, match="has no nodes 'end'"):
        shell.edge("end")
    mesh = nc.mesh.rectangle((1.0, 1.0), (2, 2))
    inner = nc.mesh.Mesh(mesh.nodes, mesh.cells, {"middle": np.array([4])})
    plate = scene.add(nc.Shell(inner, thickness=0.1, material=RUBBER))
    with pytest.raises(ValueError, match="the nodes 'middle' are no edge"):
        plate.edge("middle")
    skin = scene.add(nc.Shell(mesh, thickness=0.1, material=RUBBER, bending=False))
    with pytest.raises(ValueError, match="no edges with directors; take those of a shell that bends"):
        skin.edge("right")
