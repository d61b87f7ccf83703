"""Pictures: drawn from what a run gives, matplotlib loaded only then."""

import shutil

import matplotlib

matplotlib.use("agg")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import matplotlib.figure  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

import natcoord_jax as nc  # noqa: E402
from natcoord_jax import gallery  # noqa: E402
from natcoord_jax.viz.motion import GHOSTLY, lanes_of, scenery_at, together  # noqa: E402
from natcoord_jax.viz.outline import bodies_of  # noqa: E402
from natcoord_jax.viz.panels import Curve, Panel, draw  # noqa: E402
from natcoord_jax.viz.parts import seats  # noqa: E402
from natcoord_jax.viz.skins import beam_skins, drawn_bodies, with_ground  # noqa: E402
from natcoord_jax.viz.solutions import solution_panels  # noqa: E402


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


def test_animation_as_html_file_and_mp4(run, tmp_path):
    file = nc.animate(*run, file=tmp_path / "film.html", fps=10, title="two rods")
    assert "<script" in file.read_text("utf-8") and file.stat().st_size < 3e6
    if shutil.which("ffmpeg") is None:
        with pytest.raises(RuntimeError, match="ffmpeg"):
            nc.animate(*run, file=tmp_path / "film.mp4")
        return
    film = nc.animate(*run, file=tmp_path / "film.mp4", fps=10)
    assert film.read_bytes()[4:8] == b"ftyp" and film.stat().st_size < 3e6


def test_pictures_look_into_a_box(run, tmp_path):
    """What is outside at a time is not drawn then, and does not widen the picture."""
    phases = nc.Phases((run[0],), (run[1],))
    times = np.asarray(run[1].t)
    places = np.asarray(run[1].q).reshape(len(times), -1, 4, 3)[:, :, 0]
    # The second rod leaves it half way.
    axis = np.abs(places[-1, 1] - places[0, 1]).argmax()
    ends = np.full((2, 3), 1e3) * [[-1.0], [1.0]]
    ends[int(places[-1, 1, axis] > places[0, 1, axis]), axis] = places[len(times) // 2, 1, axis]
    box = tuple(map(tuple, ends))
    seen = [s for s in scenery_at(phases, times, within=box).solids if s.kind == "body"]
    there = np.isfinite([s.rows[:, 0, 0] for s in seen])
    expected = ((places >= ends[0]) & (places <= ends[1])).all(axis=2).T
    np.testing.assert_array_equal(there, expected)
    assert 0 < there.sum() < there.size
    page = nc.view(*run, file=tmp_path / "nothing.html", within=((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)))
    assert page.stat().st_size > 1000


def test_animation_refuses_other_files(run):
    with pytest.raises(ValueError, match=r"\.gif, \.mp4, \.html"):
        nc.animate(*run, file="film.avi")


def test_bodies_without_a_shape_are_the_plainest_solid_with_their_inertia():
    """A box, a disc, a rod and a ball, each placed off the reference point, have their own size again."""
    solids = {
        "box": nc.Box((0.4, 0.3, 0.2)),
        "disc": nc.Cylinder(0.3, 0.1),
        "rod": nc.Cylinder(0.03, 1.0),
        "ball": nc.Sphere(0.2),
    }
    for name, shape in solids.items():
        scene = nc.Scene()
        mass, inertia = shape.mass_properties(jnp.asarray(1000.0))
        scene.add(nc.RigidBody(mass=mass, inertia=inertia, com=(1, 2, 3)))
        system, _ = scene.compile()
        ((points, _), is_round) = bodies_of(system, [0])[0]
        assert is_round == (name != "box")
        assert sorted(np.ptp(points, axis=0)) == pytest.approx(sorted(np.ptp(shape.surface()[0], axis=0)))
        assert 0.5 * (points.min(axis=0) + points.max(axis=0)) == pytest.approx((1, 2, 3))


def test_round_bodies_are_marked(run):
    """Else nobody sees a wheel spin."""
    example = gallery.load("spacecraft")
    trajectory = example.simulate(steps=2)
    shown = scenery_at(nc.Phases((example.system,), (trajectory,)), np.array([0.0, 0.1]))
    shades = {s.name: s.shade for s in shown.solids if s.kind == "body"}
    assert len(np.unique(shades["wheel 1"])) == 2 and len(np.unique(shades["base"])) == 1
    assert [s.name for s in shown.solids if s.kind == "joint"] == ["hinge 1", "hinge 2", "hinge 3"]


def test_a_hinge_is_drawn_on_its_axis_where_the_bodies_are():
    """The head of the bicycle is given where its axis meets the road."""
    system = gallery.load("bicycle").system
    head = system.joint_index("head")
    moved = seats(system)[head] - np.asarray(system.frames)[head]
    fork = seats(system)[head, 1, 0, 1:]
    assert np.linalg.norm(fork) < 0.1 and np.abs(moved[:, 1:]).max() == 0
    axis = np.asarray(system.frames)[head, 1, 3, 1:]
    assert np.linalg.norm(np.cross(moved[1, 0, 1:], axis)) < 1e-12
    hub = system.joint_index("rear hub")
    assert np.all(seats(system)[hub] == np.asarray(system.frames)[hub])


def test_errors_of_what_is_kept_are_small_and_look_small(run):
    figure = nc.plot(*run)
    [errors] = [axes for axes in figure.axes if "what is kept" in axes.get_title()]
    assert errors.get_yscale() == "log" and errors.get_ylim()[1] >= 1e-5
    for line in errors.lines:
        values = np.asarray(line.get_ydata())
        assert values.max() < 1e-13 and np.all(np.diff(values) >= 0)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles.index("joint rates") == titles.index("joint angles") + 1


def test_curves_on_each_other_are_told_apart():
    t = np.linspace(0, 1, 5)
    curves = [Curve("one", t, t), Curve("same", t, t + 1e-9), Curve("other", t, 1 - t)]
    axes = matplotlib.figure.Figure().add_subplot()
    draw(axes, Panel("", "", curves, bounds=(1.5,), goals=[(1.0, 1.0)]))
    styles = [line.get_linestyle() for line in axes.lines]
    assert styles[:3] == ["-", "--", "-"] and styles[3] == ":"
    assert [text.get_text() for text in axes.get_legend().get_texts()][3:] == ["bound", "goal"]


def test_batches_are_bands(run):
    system, one = run
    batch = jax.tree.map(lambda x: jnp.stack([x, x + 0 * x]), one)
    figure = nc.plot(system, batch)
    [angles] = [axes for axes in figure.axes if axes.get_title() == "joint angles"]
    assert len(angles.lines) == 2 and len(angles.collections) == 2
    figure = nc.plot(system, batch, times=(0.0, 0.02))
    assert len(figure.subfigs[0].axes) == 2


def test_a_batch_is_filmed_with_ghosts(run, tmp_path):
    """From vmap, of runs of different steps: each where it is at that time, at rest at its own end."""
    example = gallery.load("double_pendulum")

    def of(dt):
        return nc.simulate(example.system, example.state, dt=dt, steps=10)

    system, batch = example.system, jax.vmap(of)(jnp.array([0.005, 0.01]))
    shown = together(lanes_of(system, batch, "animate"), np.linspace(0, 0.1, 11))
    rods = [s for s in shown.solids if s.name == "rod 2" and s.kind == "body"]
    assert [s.alpha for s in rods] == [1.0, GHOSTLY]
    places = np.asarray(batch.q)[:, :, 4]
    np.testing.assert_allclose(rods[1].rows[:, 0], places[1], atol=1e-12)
    np.testing.assert_allclose(rods[0].rows[6:, 0], places[[0] * 5, 10], atol=1e-12)
    film = nc.animate(system, batch, file=tmp_path / "batch.gif", fps=5)
    assert film.read_bytes()[:3] == b"GIF"
    # Bands are at times, not at numbers of steps: at 0.05 s the first run is at its end.
    figure = nc.plot(system, batch)
    [angles] = [axes for axes in figure.axes if axes.get_title() == "joint angles"]
    own = np.asarray(system.sense(batch, "hinge 1").angle)
    t, middle = angles.lines[0].get_data()
    assert t[5] == pytest.approx(0.05) and middle[5] == pytest.approx(0.5 * (own[0, 10] + own[1, 5]))
    assert middle[10] == pytest.approx(own[1, 10])
    assert nc.balance(system, batch).energy.shape == (2, 11)
    assert system.explain(batch) == "none of 2 lanes failed"


def test_solutions_show_their_bounds_and_goals():
    """Whether they are obeyed or not: here by inputs that nobody has optimised."""
    example = gallery.load("slider_crank")
    system, state = example.system, example.state
    limits = nc.bounds.Input(-2.0, 3.0) & nc.bounds.Coordinate(-1.0, float("inf"), joint="hinge")
    aim = nc.goal.Coordinate("hinge", 0.5) & nc.goal.Rate("hinge", 0.25)
    problem = nc.OptimalControl(
        system, state, dt=0.002, steps=3, cost=nc.cost.Effort(), bounds=limits, goal=aim
    )
    solution = nc.Solution(problem, jnp.ones((3, 1)), {}, 0.002, 0.0, 0, "none", None, None, [])
    panels = {panel.title: panel for panel in solution_panels(solution)}
    assert list(panels)[:3] == ["inputs", "joint angles", "joint rates"]
    assert panels["inputs"].bounds == [-2.0, 3.0] and panels["joint angles"].bounds == [-1.0]
    assert panels["joint angles"].goals == [(0.006, pytest.approx(0.5))]
    assert panels["joint rates"].goals == [(0.006, pytest.approx(0.25))]
    nc.plot(solution)


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
    ((points, faces), _) = bodies_of(system, [0])[0]
    points = points - (1, 2, 3)
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
    states = jax.tree.map(lambda x: x[None], state)
    rows = with_ground(np.asarray(states.q))
    [skin] = beam_skins(system, states, rows, np.zeros(1, int), "parts", [beam])
    assert skin.faces.shape == (3 * 4, 4)
    size = np.ptp(skin.points.reshape(-1, 3), axis=0)
    assert size[0] == pytest.approx(0.5) and sorted(size[1:]) == pytest.approx([0.02, 0.04])
    # Without the handle: the ellipse of the same inertia, half axes of edge / sqrt(3), if it is slender.
    [skin] = beam_skins(system, states, rows, np.zeros(1, int), "parts")
    round_ = np.ptp(skin.points.reshape(-1, 3), axis=0)
    most = 2 * 0.02 * 0.5
    assert sorted(round_[1:]) == pytest.approx([min(most, 2 * 0.02 / np.sqrt(3)), most])
    assert [system.structure.bodies[k] for k in drawn_bodies(system)] == ["body 1"]
    run = nc.simulate(system, state, dt=0.01, steps=5)
    file = nc.animate(system, run, file=tmp_path / "beam.gif", beams=[beam])
    assert file.read_bytes()[:3] == b"GIF"
    figure = nc.plot(system, run, times=(0.0, 0.02, 0.05, 9.0), beams=[beam])
    figure.canvas.draw()
    above, below = figure.subfigs
    assert [axes.get_title() for axes in above.axes] == ["t = 0 s", "t = 0.02 s", "t = 0.05 s"]
    assert [axes.get_title() for axes in below.axes][0] == "energy by store"
    faces = [c for axes in above.axes for c in axes.collections if c.__class__.__name__ == "Poly3DCollection"]
    assert any(len(c.get_paths()) >= 3 * 4 + 6 for c in faces)
