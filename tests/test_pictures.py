"""Pictures: drawn from what a run gives, matplotlib loaded only then."""

import shutil
from functools import cache
from itertools import product

import matplotlib

matplotlib.use("agg")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from mpl_toolkits.mplot3d.proj3d import proj_transform  # noqa: E402
from pages import Page, still  # noqa: E402

import natcoord_jax as nc  # noqa: E402
from natcoord_jax import gallery, viz  # noqa: E402


@cache
def run():
    example = gallery.load("double_pendulum")
    return example.system, example.simulate(steps=10)


def axes_by_title(figure):
    return {axes.get_title(): axes for axes in figure.axes}


def test_plot(tmp_path):
    """Errors of what is kept are small and look small; rates are beside their angles."""
    figure = nc.plot(*run())
    titles = [axes.get_title() for axes in figure.axes]
    assert "energy by store" in titles
    assert titles.index("joint rates") == titles.index("joint angles") + 1
    [errors] = [axes for axes in figure.axes if "what is kept" in axes.get_title()]
    assert errors.get_yscale() == "log" and errors.get_ylim()[1] >= 1e-5
    for line in errors.lines:
        values = np.asarray(line.get_ydata())
        assert values.max() < 1e-13 and np.all(np.diff(values) >= 0)
    figure.savefig(tmp_path / "figure.png")


def test_animations(tmp_path):
    """As HTML in a notebook and in a file, as GIF and, with ffmpeg, as MP4; nothing else."""
    text = nc.animate(*run(), fps=20)._repr_html_()
    assert "<script" in text or "<img" in text
    assert nc.animate(*run(), file=tmp_path / "film.gif", fps=20).read_bytes()[:3] == b"GIF"
    file = nc.animate(*run(), file=tmp_path / "film.html", fps=10, title="two rods")
    assert "<script" in file.read_text("utf-8") and file.stat().st_size < 3e6
    with pytest.raises(ValueError, match=r"\.gif, \.mp4, \.html"):
        nc.animate(*run(), file="film.avi")
    if shutil.which("ffmpeg") is None:
        with pytest.raises(RuntimeError, match="ffmpeg"):
            nc.animate(*run(), file=tmp_path / "film.mp4")
        return
    film = nc.animate(*run(), file=tmp_path / "film.mp4", fps=10)
    assert film.read_bytes()[4:8] == b"ftyp" and film.stat().st_size < 3e6


def test_pictures_look_into_a_box(tmp_path):
    """What is outside at a time is not drawn then, and does not widen the picture."""
    system, trajectory = run()
    places = np.asarray(trajectory.q).reshape(len(trajectory.t), -1, 4, 3)[:, :, 0]
    # The second rod leaves it half way.
    axis = np.abs(places[-1, 1] - places[0, 1]).argmax()
    ends = np.full((2, 3), 1e3) * [[-1.0], [1.0]]
    ends[int(places[-1, 1, axis] > places[0, 1, axis]), axis] = places[len(places) // 2, 1, axis]
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html", within=tuple(map(tuple, ends))))
    drawn = np.isfinite([part.rows[0, :, 0, 0] for part in page.parts("body")])
    inside = ((places >= ends[0]) & (places <= ends[1])).all(axis=2).T
    np.testing.assert_array_equal(drawn, inside)
    assert 0 < drawn.sum() < drawn.size
    nowhere = ((50.0, 50.0, 50.0), (51.0, 51.0, 51.0))
    assert nc.view(system, trajectory, file=tmp_path / "a.html", within=nowhere).stat().st_size > 1000


SHAPES = {
    "box": (nc.Box((0.4, 0.3, 0.2)), (0.4, 0.3, 0.2)),
    "sphere": (nc.Sphere(0.2), (0.4, 0.4, 0.4)),
    "cylinder": (nc.Cylinder(0.2, 0.6), (0.4, 0.4, 0.6)),
    "ellipsoid": (nc.Ellipsoid((0.1, 0.2, 0.3)), (0.2, 0.4, 0.6)),
}
SOLIDS = {
    "plain box": nc.Box((0.4, 0.3, 0.2)),
    "plain disc": nc.Cylinder(0.3, 0.1),
    "plain rod": nc.Cylinder(0.03, 1.0),
    "plain ball": nc.Sphere(0.2),
}


def solids():
    """Bodies with shapes, and bodies with the inertia of some, all placed off their reference points."""
    scene = nc.Scene()
    for name, (shape, _) in SHAPES.items():
        scene.add(nc.RigidBody(shape=shape, density=1000.0, com=(1, 2, 3), name=name))
    for name, shape in SOLIDS.items():
        mass, inertia = shape.mass_properties(jnp.asarray(1000.0))
        scene.add(nc.RigidBody(mass=mass, inertia=inertia, com=(1, 2, 3), name=name))
    system, state = scene.compile()
    return system, still(system, state)


def test_bodies_are_drawn_as_their_shapes(tmp_path):
    """Right size and place, and all points on the surface: the normalised radius is one.

    Without a shape: as the plainest solid with their inertia, of the size that it had. Round ones are marked,
    else nobody sees a wheel spin.
    """
    page = Page(nc.view(*solids(), file=tmp_path / "a.html"))
    for name, (_, size) in SHAPES.items():
        points = page.part(name).place - (1, 2, 3)
        assert np.ptp(points, axis=0) == pytest.approx(size, rel=1e-3), name
        x, y, z = (2 * points / size).T
        on = {"box": np.abs(x) * np.abs(y) * np.abs(z), "cylinder": (x**2 + y**2) * np.abs(z)}
        # (The middle of an end of a cylinder is on it, too.)
        radius = np.maximum(
            on.get(name, x**2 + y**2 + z**2), np.abs(z) * (name == "cylinder") * (x**2 + y**2 < 0.1)
        )
        assert radius == pytest.approx(1.0, abs=1e-2), name
    for name, shape in SOLIDS.items():
        part = page.part(name)
        sizes = sorted(np.ptp(shape.surface()[0], axis=0))
        assert sorted(np.ptp(part.place, axis=0)) == pytest.approx(sizes, rel=1e-3), name
        assert 0.5 * (part.place.min(axis=0) + part.place.max(axis=0)) == pytest.approx((1, 2, 3), rel=1e-3)
        assert len(np.unique(part.shade)) == (1 if name == "plain box" else 2), name


@pytest.mark.exhaustive
@pytest.mark.parametrize("size", ((10.0, 0.4, 0.1), (0.1, 0.4, 10.0), (1.0, 1.0, 1.0)))
def test_what_is_long_is_seen_to_its_ends(size):
    scene = nc.Scene()
    scene.add(nc.RigidBody(shape=nc.Box(size), density=1000.0))
    system, state = scene.compile()
    motion = nc.Phases((system,), (still(system, state),))
    figure = viz.plot_snapshots(
        motion, (0.0,), [viz.Panel("", "", [viz.Curve("line", np.arange(2.0), np.arange(2.0))])]
    )
    figure.draw_without_rendering()
    [axes] = figure.subfigs[0].axes
    corners = 0.5 * np.array(size) * list(product((-1, 1), repeat=3))
    places = proj_transform(*corners.T, axes.get_proj())[:2]
    seen = axes.transAxes.inverted().transform(axes.transData.transform(np.transpose(places)))
    assert 0.0 <= seen.min() and seen.max() <= 1.0
    # ... and is not small.
    assert np.ptp(seen, axis=0).max() > 0.6


@pytest.mark.exhaustive
def test_a_shape_elsewhere_hangs_on_its_body(tmp_path):
    """As that of a link which has one for contact at its joint."""
    ball = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<inertial><origin xyz="0 0 -0.5"/><mass value="2"/>{inertia}</inertial>{ball}'
    joint = '<joint name="joint" type="continuous"><parent link="base"/><child link="link"/></joint>'
    text = f'<robot name="arm"><link name="base"/><link name="link">{link}</link>{joint}</robot>'
    scene = nc.Scene()
    scene.add(nc.io.load(text))
    system, state = scene.compile()
    arm = Page(nc.view(system, still(system, state), file=tmp_path / "a.html")).part("link", "arm")
    assert (arm.place[:, 2].min(), arm.place[:, 2].max()) == pytest.approx((-0.5, 0.0), abs=1e-3)


@pytest.mark.exhaustive
def test_a_hinge_is_drawn_on_its_axis_where_the_bodies_are(tmp_path):
    """The head of the bicycle is given where its axis meets the road."""
    example = gallery.load("bicycle")
    system = example.system
    trajectory = still(system, example.state)
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html"))
    rows = np.asarray(trajectory.states.rows)[0]

    def of_frame(name):
        """Origin and axis as given, seen from the first body of the joint that moves."""
        joint = system.joint_index(name)
        frame = np.asarray(system.get(name, "frames"))[1]
        child = int(np.asarray(system.joint_bodies)[joint, 1])
        return frame @ rows[child], rows[child]

    frame, fork = of_frame("head")
    head = page.part("head", "joint")
    moved = head.rows[0, 0, 0] - frame[0]
    assert np.linalg.norm(head.rows[0, 0, 0] - fork[0]) < 0.1 and np.linalg.norm(moved) > 0.1
    assert np.linalg.norm(np.cross(moved, frame[3])) < 1e-3
    frame, _ = of_frame("rear hub")
    hub = page.part("rear hub", "joint")
    np.testing.assert_allclose(hub.rows[0, 0, 0], frame[0], atol=2 * hub.step)


def test_curves_on_each_other_are_told_apart():
    t = np.linspace(0, 1, 5)
    curves = [viz.Curve("one", t, t), viz.Curve("same", t, t + 1e-9), viz.Curve("other", t, 1 - t)]
    panel = viz.Panel("", "", curves, bounds=(1.5,), goals=[(1.0, 1.0)])
    axes = viz.plot_panels([panel]).axes[0]
    styles = [line.get_linestyle() for line in axes.lines]
    assert styles[:3] == ["-", "--", "-"] and styles[3] == ":"
    legend = axes.get_legend()
    assert [text.get_text() for text in legend.get_texts()][3:] == ["bound", "goal"]
    # Dashes of many curves are farther apart than keys are wide: there they are plain.
    same = viz.Panel("", "", [viz.Curve(str(k), t, t) for k in range(8)])
    keys = viz.plot_panels([same]).axes[0].get_legend().legend_handles
    plain = viz.plot_panels([viz.Panel("", "", [viz.Curve("plain", t, t, dashed=True)])]).axes[0]
    assert {key._unscaled_dash_pattern for key in keys[1:]} == {plain.lines[0]._unscaled_dash_pattern}


def test_batches_are_bands(tmp_path):
    system, one = run()
    batch = jax.tree.map(lambda x: np.stack([x, x]), one)
    angles = axes_by_title(nc.plot(system, batch))["joint angles"]
    assert len(angles.lines) == 2 and len(angles.collections) == 2
    figure = nc.plot(system, batch, times=(-1.0, 0.0, 0.02, 5.0))
    assert len(figure.subfigs[0].axes) == 2
    with pytest.raises(ValueError, match=r"times \[s\] has none of the motion, which goes from 0 to .* s"):
        nc.plot(system, one, times=(5.0,))


@pytest.mark.exhaustive
def test_a_batch_is_filmed_with_ghosts(tmp_path):
    """From vmap, of runs of different steps: each where it is at that time, at rest at its own end."""
    example = gallery.load("double_pendulum")

    def of(dt):
        return nc.simulate(example.system, example.state, dt=dt, steps=10)

    system, batch = example.system, jax.vmap(of)(jnp.array([0.005, 0.01]))
    rod = Page(nc.view(system, batch, file=tmp_path / "a.html")).part("rod 2")
    places = np.asarray(batch.q)[:, :, 4]
    np.testing.assert_allclose(rod.rows[1, :, 0], places[1], atol=rod.step)
    np.testing.assert_allclose(rod.rows[0, 6:, 0], places[[0] * 5, 10], atol=rod.step)
    film = nc.animate(system, batch, file=tmp_path / "batch.gif", fps=5)
    assert film.read_bytes()[:3] == b"GIF"
    # Bands are at times, not at numbers of steps: at 0.05 s the first run is at its end.
    angles = axes_by_title(nc.plot(system, batch))["joint angles"]
    hinge = np.asarray(system.sense(batch, "hinge 1").angle)
    t, middle = angles.lines[0].get_data()
    assert t[5] == pytest.approx(0.05) and middle[5] == pytest.approx(0.5 * (hinge[0, 10] + hinge[1, 5]))
    assert middle[10] == pytest.approx(hinge[1, 10])
    assert nc.balance(system, batch).energy.shape == (2, 11)
    assert system.explain(batch) == "none of 2 lanes failed"


@pytest.mark.exhaustive
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
    panels = axes_by_title(nc.plot(solution))
    assert list(panels)[:3] == ["inputs", "joint angles", "joint rates"]

    def bounds(axes):
        return [line.get_ydata()[0] for line in axes.lines if line.get_linestyle() == ":"]

    def goals(axes):
        return [tuple(map(float, (*x, *y))) for x, y in (
            line.get_data() for line in axes.lines if line.get_marker() == "*"
        )]  # fmt: skip

    assert bounds(panels["inputs"]) == [-2.0, 3.0] and bounds(panels["joint angles"]) == [-1.0]
    assert goals(panels["joint angles"]) == [pytest.approx((0.006, 0.5))]
    assert goals(panels["joint rates"]) == [pytest.approx((0.006, 0.25))]


@pytest.mark.exhaustive
def test_beams_are_drawn_as_swept_sections(tmp_path):
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = scene.add(nc.RigidBody(shape=nc.Box((0.1, 0.1, 0.1)), density=500.0, position=(0.55, 0, 0)))
    section = nc.RectangularSection(width=0.02, height=0.04, E=1e8, density=1000.0)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (0.5, 0, 0)], elements=3, start=nc.ground, end=box))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=5)

    def swept(**options):
        page = Page(nc.view(system, trajectory, file=tmp_path / "a.html", colour="parts", **options))
        assert [part.name for part in page.parts("body")] == ["body 1"]
        [skin] = page.skins
        return skin, np.ptp(skin.points[0, 0], axis=0)

    skin, size = swept(beams=[beam])
    assert skin.faces.shape == (3 * 4, 4)
    assert size[0] == pytest.approx(0.5, abs=1e-4)
    assert sorted(size[1:]) == pytest.approx([0.02, 0.04], abs=1e-4)
    # Without the handle: the ellipse of the same inertia, half axes of edge / sqrt(3), if it is slender.
    _, size = swept()
    most = 2 * 0.02 * 0.5
    assert sorted(size[1:]) == pytest.approx([min(most, 2 * 0.02 / np.sqrt(3)), most], abs=1e-4)
    file = nc.animate(system, trajectory, file=tmp_path / "beam.gif", beams=[beam])
    assert file.read_bytes()[:3] == b"GIF"
    figure = nc.plot(system, trajectory, times=(0.0, 0.02, 0.05, 9.0), beams=[beam])
    figure.canvas.draw()
    above, below = figure.subfigs
    assert [axes.get_title() for axes in above.axes] == ["t = 0 s", "t = 0.02 s", "t = 0.05 s"]
    assert [axes.get_title() for axes in below.axes][0] == "energy by store"
    faces = [c for axes in above.axes for c in axes.collections if c.__class__.__name__ == "Poly3DCollection"]
    assert any(len(c.get_paths()) >= 3 * 4 + 6 for c in faces)
