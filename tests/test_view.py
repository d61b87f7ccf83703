"""The view in three dimensions: what is in its file, and what a browser makes of it."""

import dataclasses
import re
import shutil
import subprocess
import sys
import urllib.request
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pages import Page, still

import natcoord_jax as nc
from natcoord_jax import gallery

CHROMIUM = next((p for p in ("chromium", "chromium-browser", "google-chrome") if shutil.which(p)), None)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-sync --no-first-run --window-size=700,500 --enable-logging=stderr --virtual-time-budget=3000"
).split()


@cache
def rods():
    example = gallery.load("double_pendulum")
    return example.system, example.simulate(steps=40)


@cache
def sheet():
    """A plate of shells, a ball on the floor and a rod on a motor: all that is drawn is there once."""
    x, y = np.meshgrid(np.linspace(0, 1, 3), np.linspace(0, 1, 2), indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    number = np.arange(6).reshape(3, 2)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    scene = nc.Scene()
    scene.add(nc.Gravity())
    nodes = scene.add(
        nc.Nodes.directors(
            places, (0, 0, 1), mass=1.0, inertia=0.01, angular_velocity=(0.5, 0, 0), name="mesh"
        )
    )
    scene.add(nc.ShellElement.on(nodes, quads, thickness=0.05, material=nc.Elastic(E=1e5), name="plate"))
    ends = (nc.Point(nc.ground, (0, 0, 1)), nc.Point(nodes[0]))
    scene.add(nc.Spring(ends, stiffness=30.0, length=0.5, name="spring"))
    scene.add(nc.PointForce((nc.Point(nodes[5]),), force=(0, 0, 5.0), name="push"))
    ball = nc.RigidBody(shape=nc.Sphere(0.1), density=400.0, position=(3, 0, 0.1), name="ball")
    scene.add(nc.Contact(scene.add(ball), nc.Plane(), restitution=0.0, name="floor"))
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=(0.3, 0, 0), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    trace = nc.Point(nodes[5], (1.0, 1.0, 0.0))
    return system, nc.simulate(system, state, dt=0.01, steps=10, inputs=np.array([3.0])), trace


def test_the_file_holds_the_motion(tmp_path):
    system, trajectory = rods()
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html", title="two <rods>", follow="rod 2"))
    assert len(page.text) < 200_000 and "two &lt;rods>" in page.text
    assert not re.search(r"(src|href)=.?(http|//)|@import|url\(|fetch\(|XMLHttp", page.text), "it loads more"
    assert page.scene["follow"] == "rod 2" and page.scene["bodies"] == ["rod 1", "rod 2"] and page.lanes == 1
    assert [part.name for part in page.parts("joint")] == ["hinge 1", "hinge 2"]
    second = page.part("rod 2")
    assert second.rows.shape == (1, 41, 4, 3) and second.step < 4e-4
    np.testing.assert_allclose(second.rows[0], np.asarray(trajectory.q)[:, 4:8], atol=0.51 * second.step)
    np.testing.assert_allclose(page.scene["times"], trajectory.t)


@pytest.mark.exhaustive
def test_surfaces_springs_forces_and_traces(tmp_path):
    system, trajectory, corner = sheet()
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html", colour="energy", traces=[corner]))
    places = np.asarray(trajectory.states.rows)[:, :, 0]
    [skin] = page.skins
    assert skin.faces.shape == (2, 4) and skin.label == "stored energy [J/m\u00b2]"
    energy = np.asarray(system.energy(trajectory).stores["plate"])
    np.testing.assert_allclose(skin.values[0].sum(axis=1) * 0.5, energy, atol=1e-4 * energy.max())
    assert [part.name for part in page.parts("link")] == ["spring"]
    assert [part.name for part in page.parts("joint")] == ["hinge"]
    # A spring reaches from end to end; the last of its vectors is along it.
    spring = page.part("spring", "link")
    first = places[:, system.body_index("mesh[0]")]
    np.testing.assert_allclose(spring.rows[0, :, 0], [[0, 0, 1]] * 11, atol=spring.step)
    np.testing.assert_allclose(spring.rows[0, :, 3], first - (0, 0, 1), atol=2 * spring.step)
    [trace] = page.scene["traces"]
    path = page.numbers(trace["points"]).reshape(-1, 3)
    np.testing.assert_allclose(path, places[:, system.body_index("mesh[5]")], atol=1e-4)
    lowest = min(np.min(x[..., 2]) for x in [skin.points, *(part.corners for part in page.parts("body"))])
    assert page.scene["ground"] == pytest.approx(lowest, abs=0.01), "the ground is not below all bodies"
    arrows = {part.name: part.rows[0] for part in page.parts("force")}
    assert sorted(arrows) == ["floor", "motor", "push"]
    assert np.all(arrows["push"][:, 3, 2] > 0) and np.abs(arrows["push"][:, 3, :2]).max() < 1e-3
    assert np.all(arrows["floor"][2:, 3, 2] > 0) and np.abs(arrows["floor"][2:, 3, :2]).max() < 1e-3
    assert np.all(arrows["motor"][:, 3, 1] > 0), "a torque is an arrow about its axis"


@pytest.mark.exhaustive
def test_contacts_and_motors_have_arrows_of_their_sizes(tmp_path):
    """Two balls at rest carry their weights; motors turn about their axes and push along them."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    for name, x, density in (("light", 0.0, 400.0), ("heavy", 1.0, 800.0)):
        ball = nc.RigidBody(shape=nc.Sphere(0.1), density=density, position=(x, 0, 0.1), name=name)
        scene.add(nc.Contact(scene.add(ball), nc.Plane(), restitution=0.0, name=f"floor of {name}"))
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=(0.3, 0, 0), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    car = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0, 2, 0), name="car"))
    rail = scene.add(nc.Prismatic(nc.ground, car, point=(0, 2, 0), axis=(1, 0, 0), name="rail"))
    scene.add(nc.JointForce(rail, name="push"))
    servo = nc.AffineActuator((hinge,), gain=(2.0, 0, 0), bias=(0, -2.0, 0), name="servo")
    scene.add(servo)
    system, state = scene.compile()
    torques = jnp.tile(jnp.array([3.0, -4.0, 0.5]), (8, 1))
    trajectory = nc.simulate(system, state, dt=0.01, inputs=torques)
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html"))
    arrows = {part.name: part.rows[0] for part in page.parts("force")}
    near = 2 * max(part.step for part in page.parts("force"))
    assert list(arrows) == ["push", "motor", "servo", "floor of light", "floor of heavy"]
    one, two = arrows["floor of light"], arrows["floor of heavy"]
    np.testing.assert_allclose(two[2:, 0], [[1.0, 0, 0]] * 7, atol=near)
    np.testing.assert_allclose(two[2:, 3], 2 * one[2:, 3], atol=2 * near)
    assert np.all(one[2:, 3, 2] > 0) and np.abs(one[2:, 3, :2]).max() < near
    place = system.body_index("car")
    np.testing.assert_allclose(arrows["push"][:, 0], np.asarray(trajectory.q)[:, 4 * place], atol=near)
    assert np.all(arrows["push"][:, 3, 0] < 0) and np.abs(arrows["push"][:, 3, 1:]).max() < near
    # A turning arrow is as wide as it is long: 3 N m of the motor, 2 (0.5 - angle) of the servo.
    angle = np.asarray(system.sense(trajectory, hinge).angle)
    motor, servo = arrows["motor"], arrows["servo"]
    np.testing.assert_allclose(servo[:, 3], np.outer(2 * (0.5 - angle) / 3, motor[0, 3]), atol=2 * near)
    np.testing.assert_allclose(np.linalg.norm(motor[:, 1], axis=1), motor[:, 3, 1], atol=2 * near)


@pytest.mark.exhaustive
def test_gaps_of_a_contact_have_one_arrow(tmp_path):
    """A block of rubber on the floor: one arrow, from below its middle."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rubber = nc.Elastic(E=1e6, nu=0.3, density=1000.0)
    block = scene.add(nc.Solid(nc.mesh.box((1, 1, 0.5), (1, 1, 1)), material=rubber, name="block"))
    scene.add(nc.Contact(block.face("z0"), nc.Plane(), stiffness=1e5, name="floor"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=3)
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html"))
    [force] = page.parts("force")
    assert force.name == "floor" and force.rows[0, 3, 3, 2] > 0
    np.testing.assert_allclose(force.rows[0, 1:, 0, :2], 0.5, atol=2 * force.step)


def momentum(system, trajectory, body):
    """Of the nodes of a solid (t, 3), without what is clamped."""
    nodes = [k for k, name in enumerate(system.structure.bodies) if name.startswith(body)]
    mass = np.asarray(system.mass)[nodes, 0, 0]
    return np.einsum("n,tnx->tx", mass, np.asarray(trajectory.states.row_rates)[:, nodes, 0])


@pytest.mark.exhaustive
def test_nodes_on_surfaces_have_arrows_that_are_the_force_together(tmp_path):
    """A block falls flat on another: what changes its momentum, on four nodes."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    falling = {"material": rubber, "velocity": (0, 0, -2.0), "position": (0.3, 0.2, 1.001)}
    upper = scene.add(nc.Solid(nc.mesh.box((1, 0.8, 1), (1, 1, 1)), **falling, name="upper"))
    lower = scene.add(nc.Solid(nc.mesh.box((2, 2, 1), (1, 1, 1)), material=rubber, name="lower"))
    contact = nc.Contact(upper.face("z0"), lower.face("z1"), one_pass=True, name="impact")
    scene.add(contact)
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=12)
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html"))
    forces = page.parts("force")
    assert [part.name for part in forces] == ["impact"] * 4
    arrows, near = np.stack([part.rows[0] for part in forces])[:, 1:], max(part.step for part in forces)
    drawn = np.isfinite(arrows).all(axis=(2, 3))
    long = np.linalg.norm(arrows[:, :, 3], axis=-1)
    largest = nc.contacts(system, trajectory).force.max()
    force = np.nan_to_num(arrows[:, :, 3]).sum(axis=0) * largest / long[drawn].max()
    wanted = np.diff(momentum(system, trajectory, "upper"), axis=0) / 2e-3
    assert wanted[:, 2].max() > 10.0 and drawn.any(axis=0).sum() > 5
    np.testing.assert_allclose(force, wanted, atol=0.01 * wanted.max())
    nodes = np.asarray(trajectory.states.rows)[1:, :, 0]
    apart = np.linalg.norm(nodes - arrows[:, :, None, 0], axis=-1).min(axis=2)
    assert apart[drawn].max() < 2 * near, "an arrow that begins at no node"
    assert np.all(np.linalg.norm(arrows[:, :, 1], axis=-1)[drawn] < 0.21 * long[drawn] + near), "discs"


@pytest.mark.slow
def test_forces_are_drawn_over_what_they_are_inside_of():
    """Could go wrong: one list of faces, in which those of a body hide the force of a contact below it."""
    figure = nc.plot(*sheet()[:2], times=(0.1,))
    [axes] = figure.subfigs[0].axes
    layers = [layer for layer in axes.collections if layer.__class__.__name__ == "Poly3DCollection"]
    *_, bodies, forces = sorted(layers, key=lambda layer: layer.get_zorder())
    assert forces.get_zorder() > bodies.get_zorder() > 0
    # Those of contacts are green, of loads and motors red: nothing else is in that layer.
    colours = np.unique(np.argmax(forces.get_facecolor()[:, :3], axis=1))
    assert colours.tolist() == [0, 1]


@pytest.mark.exhaustive
def test_a_run_without_the_contacts_of_others_is_shown_with_them(tmp_path):
    """Could go wrong: forces that act in one run of a batch, taken for those of another one."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = nc.RigidBody(shape=nc.Sphere(0.1), density=400.0, position=(0, 0, 0.5), name="ball")
    scene.add(nc.Contact(scene.add(ball), nc.Plane(), restitution=0.5, name="floor"))
    system, state = scene.compile()
    heights = jnp.array([5.0, 0.3])

    def run(height):
        moved = dataclasses.replace(state, q=state.q.at[0, 2].set(height))
        return nc.simulate(system, moved, dt=0.01, steps=40)

    trajectory = jax.vmap(run)(heights)
    for k, order in enumerate(([0, 1], [1, 0])):
        pair = jax.tree.map(lambda x, order=order: x[jnp.array(order)], trajectory)
        [force] = Page(nc.view(system, pair, file=tmp_path / "a.html")).parts("force")
        assert np.isnan(force.rows[k]).all() and np.isfinite(force.rows[1 - k]).any()


@pytest.mark.slow
def test_values_of_elements_that_are_handed_over(tmp_path):
    system, trajectory, _ = sheet()
    page = Page(nc.view(system, trajectory, file=tmp_path / "a.html", colour={"plate": [1.0, 3.0]}))
    [skin] = page.skins
    assert skin.label == "plate" and page.scene["skins"][0]["range"] == [0.0, 3.0]
    assert skin.values[0, 4] == pytest.approx([1.0, 3.0], abs=1e-3)
    with pytest.raises(ValueError, match=r"'plate' got values of shape \(3,\); pass one for each of its 2"):
        nc.view(system, trajectory, file=tmp_path / "a.html", colour={"plate": [1.0, 2.0, 3.0]})


def test_batches_are_lanes(tmp_path):
    system, trajectory = rods()
    batch = jax.tree.map(lambda x: np.stack([x] * 20), trajectory)
    assert Page(nc.view(system, batch, file=tmp_path / "batch.html")).lanes == 16
    pairs = jax.tree.map(lambda x: np.stack([x] * 2), batch)
    assert Page(nc.view(system, pairs, file=tmp_path / "batch.html")).lanes == 16


@pytest.mark.exhaustive
def test_phases_with_joints_that_come_and_go(tmp_path):
    def scene(hinged):
        made = nc.Scene()
        made.add(nc.Gravity())
        ball = made.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), name="ball"))
        if hinged:
            made.add(nc.Revolute(nc.ground, ball, point=(1, 0, 0), axis=(0, 1, 0), name="hinge"))
        return made.compile()

    system, state = scene(hinged=True)
    swing = nc.simulate(system, state, dt=0.01, steps=5)
    flying, state = nc.transfer(system, swing[-1], scene(False)[0])
    flight = nc.simulate(flying, state, dt=0.01, steps=5)
    phases = nc.Phases((system, flying), (swing, flight))
    [hinge] = Page(nc.view(phases, file=tmp_path / "a.html")).parts("joint")
    there = np.isfinite(hinge.rows[0]).all(axis=(1, 2))
    assert hinge.name == "hinge" and there[:5].all() and not there[6:].any()


def test_a_run_that_broke_down_is_shown_as_far_as_it_went(tmp_path):
    system, trajectory = rods()
    broken = eqx.tree_at(lambda x: x.states.q, trajectory, trajectory.q.at[20:].set(jnp.nan))
    page = Page(nc.view(system, broken, file=tmp_path / "broken.html"))
    there = np.isfinite(page.part("rod 1").rows[0]).all(axis=(1, 2))
    assert there[:20].all() and not there[20:].any() and 0 < page.scene["size"] < 10
    nc.animate(system, broken, file=tmp_path / "broken.gif", fps=5)


TWO_HINGES = """
<mujoco><worldbody><body name="arm" pos="0 0 1">
  <joint name="yaw" axis="0 0 1"/><joint name="pitch" axis="0 1 0"/><geom type="box" size="0.5 0.1 0.1"/>
</body></worldbody></mujoco>
"""


def test_joints_on_a_body_without_mass_stay_where_they_are(tmp_path):
    """Between two hinges in one link there is a body without a centre of mass to draw them at."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(TWO_HINGES)
    scene = nc.Scene()
    scene.add(nc.io.load(tmp_path / "arm.xml"))
    system, state = scene.compile()
    nc.view(system, still(system, state), file=tmp_path / "arm.html")
    joints = Page(tmp_path / "arm.html").parts("joint")
    assert len(joints) == 2 and all(np.all(np.isfinite(joint.rows)) for joint in joints)


def test_what_it_refuses(tmp_path):
    system, trajectory = rods()
    with pytest.raises(ValueError, match="view needs the system and a trajectory"):
        nc.view(system)
    with pytest.raises(ValueError, match=r"ends in \.html"):
        nc.view(system, trajectory, file="motion.gif")
    with pytest.raises(ValueError, match="no body 'rod 3' to follow; there are rod 1, rod 2"):
        nc.view(system, trajectory, file=tmp_path / "a.html", follow="rod 3")


def test_from_a_script_it_says_where_the_file_is(capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    view = nc.view(*rods())
    file = re.search(r"open (\S+motion\.html) in a browser", capsys.readouterr().out)[1]
    assert view._repr_html_().startswith("<iframe") and len(view.html) > 10_000
    assert open(file, encoding="utf-8").read() == view.html


def test_round_faces_are_smooth_and_edges_are_seen(tmp_path):
    rod = Page(nc.view(*rods(), file=tmp_path / "a.html")).part("rod 1")
    assert rod.place.shape == rod.normal.shape and len(rod.shade) == len(rod.place) and len(rod.lines) > 0
    np.testing.assert_allclose(np.linalg.norm(rod.normal, axis=1), 1.0, atol=1e-3)
    # The mantle of a rod along x: normals at its corners point away from the axis.
    mantle = np.abs(rod.normal[:, 0]) < 1e-3
    away = rod.place[mantle][:, 1:] / np.linalg.norm(rod.place[mantle][:, 1:], axis=1, keepdims=True)
    assert mantle.sum() > 20
    np.testing.assert_allclose(np.abs(np.sum(away * rod.normal[mantle][:, 1:], axis=1)), 1.0, atol=0.02)


def test_it_is_served_live(capsys):
    pytest.importorskip("viser", reason="no viser: install the extra viz3d")
    system, trajectory = rods()
    live = nc.view(
        system, trajectory, live=True, follow="rod 2", traces=gallery.load("double_pendulum").traces
    )
    try:
        assert live.address in capsys.readouterr().out
        with urllib.request.urlopen(live.address, timeout=10) as page:
            assert page.status == 200
        live.playing.value = False
        live.now.value = 0.1
        live.show()
        place = dict(zip([s.name for s in live.lanes[0].solids], live.moved))["rod 2"].position
        np.testing.assert_allclose(place, np.asarray(trajectory.q)[20, 4], atol=1e-6)
    finally:
        live.stop()
    live = nc.view(*sheet()[:2], live=True)
    live.stop()


def test_without_viser_the_line_to_install_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r'pip install "natcoord-jax\[viz3d\]"'):
        nc.view(*rods(), live=True)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: install it, apt-get install chromium")
@pytest.mark.parametrize("name", ["rods", "sheet"])
def test_a_browser_shows_it_without_complaint(name, tmp_path):
    """Drawn at two times: something is there, it moves, and the console is silent."""
    from matplotlib.image import imread

    moving = {"rods": rods, "sheet": sheet}[name]()[:2]
    traces = gallery.load("double_pendulum").traces if name == "rods" else ()
    file = nc.view(*moving, file=tmp_path / "motion.html", title=name, traces=traces)
    colour = next((trace["colour"] for trace in Page(file).scene["traces"]), None)
    pictures = []
    for place in (0.0, 0.9):
        shot = tmp_path / f"{place}.png"
        where = [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}"]
        address = f"{(tmp_path / 'motion.html').as_uri()}#{place}"
        process = subprocess.run(
            [CHROMIUM, *FLAGS, *where, address], capture_output=True, text=True, timeout=100
        )
        lines = [line for line in process.stderr.splitlines() if "CONSOLE" in line]
        assert not [line for line in lines if "GL Driver Message" not in line], lines
        pictures.append(imread(shot)[60:420, 190:, :3])
    # Bodies are far from the grey of ground and sky.
    coloured = [float((np.ptp(p, axis=2) > 0.15).mean()) for p in pictures]
    assert min(coloured) > 1e-3, f"nothing is drawn: {coloured}"
    # The path of the tip is as long as the tip has come, and not the scribble that wrong numbers would be.
    if colour is not None:
        rows, columns = np.nonzero(np.abs(pictures[1] - colour).max(axis=2) < 0.05)
        assert len(rows) > 1 and np.ptp(rows) < 60 and np.ptp(columns) < 30, "no path, or a wrong one"
    assert float((np.abs(pictures[0] - pictures[1]).max(axis=2) > 0.1).mean()) > 1e-3, "nothing moves"
