"""Pictures: drawn from what a run gives, matplotlib loaded only then."""

import matplotlib

matplotlib.use("agg")

import numpy as np  # noqa: E402
import pytest  # noqa: E402

import natcoord_jax as nc  # noqa: E402
from natcoord_jax import gallery  # noqa: E402
from natcoord_jax.viz.outline import beam_rims, inertia_boxes, is_node, surfaces, with_ground  # noqa: E402


@pytest.fixture(scope="module")
def run():
    example = gallery.load("double_pendulum")
    return example.system, example.simulate(steps=10)


def test_plot(run, tmp_path):
    figure = nc.plot(*run)
    titles = [axes.get_title() for axes in figure.axes]
    assert "energy by store" in titles and "joint angles" in titles
    figure.savefig(tmp_path / "figure.png")


def test_animation_as_html(run):
    text = nc.animate(*run, fps=100)._repr_html_()
    assert "<script" in text or "<img" in text


def test_animation_as_gif(run, tmp_path):
    file = nc.animate(*run, file=tmp_path / "film.gif", fps=50)
    assert file.read_bytes()[:3] == b"GIF"


def test_animation_refuses_other_files(run):
    with pytest.raises(ValueError, match="gif"):
        nc.animate(*run, file="film.mp4")


def test_boxes_have_the_inertia_of_the_bodies():
    scene = nc.Scene()
    size = np.array([0.4, 0.3, 0.2])
    scene.add(nc.RigidBody(shape=nc.Box(size), density=1000.0, com=(1, 2, 3)))
    system, _ = scene.compile()
    corners = inertia_boxes(system)[0, :, 1:]
    assert np.ptp(corners, axis=0) == pytest.approx(size)
    assert corners.mean(axis=0) == pytest.approx((1, 2, 3))


SHAPES = {
    "box": (nc.Box((0.4, 0.3, 0.2)), (0.4, 0.3, 0.2)),
    "sphere": (nc.Sphere(0.2), (0.4, 0.4, 0.4)),
    "cylinder": (nc.Cylinder(0.2, 0.6), (0.4, 0.4, 0.6)),
    "ellipsoid": (nc.Ellipsoid((0.1, 0.2, 0.3)), (0.2, 0.4, 0.6)),
}


@pytest.mark.parametrize("name", SHAPES)
def test_bodies_are_drawn_as_their_shapes(name):
    """Right size and place, and every point on the surface: the normalised radius is one."""
    shape, size = SHAPES[name]
    scene = nc.Scene()
    scene.add(nc.RigidBody(shape=shape, density=1000.0, com=(1, 2, 3)))
    system, _ = scene.compile()
    [(weights, faces)] = surfaces(system)
    points = weights[:, 1:] - (1, 2, 3)
    assert np.ptp(points, axis=0) == pytest.approx(size)
    assert sorted({int(k) for face in faces for k in face}) == list(range(len(points)))
    x, y, z = (2 * points / size).T
    on = {"box": np.abs(x) * np.abs(y) * np.abs(z), "cylinder": (x**2 + y**2) * np.abs(z)}
    assert on.get(name, x**2 + y**2 + z**2) == pytest.approx(1.0)


def test_beams_are_drawn_as_swept_sections(tmp_path):
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = scene.add(nc.RigidBody(shape=nc.Box((0.1, 0.1, 0.1)), density=500.0, position=(0.55, 0, 0)))
    section = nc.RectangularSection(width=0.02, height=0.04, E=1e8, density=1000.0)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (0.5, 0, 0)], elements=3, start=nc.ground, end=box))
    system, state = scene.compile()
    rows = with_ground(np.asarray(state.q)[None])
    quads = beam_rims(system, rows, [beam])[0]
    assert quads.shape == (3 * 4, 4, 3)
    size = np.ptp(quads.reshape(-1, 3), axis=0)
    assert size[0] == pytest.approx(0.5) and sorted(size[1:]) == pytest.approx([0.02, 0.04])
    # Without the handle: the ellipse of the same mass and inertia, half axes of edge / sqrt(3).
    round_ = np.ptp(beam_rims(system, rows)[0].reshape(-1, 3), axis=0)
    assert sorted(round_[1:]) == pytest.approx([2 * 0.02 / np.sqrt(3), 2 * 0.04 / np.sqrt(3)])
    assert [is_node(system, name) for name in system.structure.bodies].count(True) == 2
    run = nc.simulate(system, state, dt=0.01, steps=5)
    file = nc.animate(system, run, file=tmp_path / "beam.gif", beams=[beam])
    assert file.read_bytes()[:3] == b"GIF"
    figure = nc.plot(system, run, times=(0.0, 0.02, 0.05, 9.0), beams=[beam])
    figure.canvas.draw()
    above, below = figure.subfigs
    assert [axes.get_title() for axes in above.axes] == ["t = 0 s", "t = 0.02 s", "t = 0.05 s"]
    assert [axes.get_title() for axes in below.axes][0] == "energy by store"
    swept = [c for axes in above.axes for c in axes.collections if c.__class__.__name__ == "Poly3DCollection"]
    assert swept and any(len(c.get_paths()) == 3 * 4 for c in swept)
