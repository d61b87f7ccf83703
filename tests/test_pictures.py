"""Pictures: drawn from what a run gives, matplotlib loaded only then."""

import matplotlib

matplotlib.use("agg")

import numpy as np  # noqa: E402
import pytest  # noqa: E402

import natcoord_jax as nc  # noqa: E402
from natcoord_jax import gallery  # noqa: E402
from natcoord_jax.viz.outline import inertia_boxes  # noqa: E402


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
