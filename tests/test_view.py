"""The view in three dimensions: what is in its file, and what a browser makes of it."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
import sys
import urllib.request
import zlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.viz import motion
from natcoord_jax.viz.packed import Blob, triangles
from natcoord_jax.viz.scenery import PALETTE
from natcoord_jax.viz.stage import Stage

CHROMIUM = next((p for p in ("chromium", "chromium-browser", "google-chrome") if shutil.which(p)), None)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-sync --no-first-run --window-size=700,500 --enable-logging=stderr --virtual-time-budget=3000"
).split()


@pytest.fixture(scope="module")
def run():
    example = gallery.load("double_pendulum")
    return example.system, example.simulate(steps=40)


@pytest.fixture(scope="module")
def sheet():
    """A plate of shells with a spring and a force, so that everything that is drawn is there once."""
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
    system, state = scene.compile()
    return system, nc.simulate(system, state, dt=0.01, steps=10)


def scene_of(text):
    """The description in a file, and its bytes."""
    described = json.loads(re.search(r"^const scene = (.*), packed = ", text, re.MULTILINE)[1])
    packed = re.search(r'packed = "([^"]*)"', text)[1]
    return described, zlib.decompress(base64.b64decode(packed))


def numbers(data, ref):
    """What the player reads: whole multiples of a step, differences along time."""
    found = np.frombuffer(data, np.int16, ref["count"], ref["at"])
    if ref["stride"]:
        found = np.cumsum(found.reshape(-1, ref["stride"]), axis=0, dtype=np.int16)
    found = found.reshape(-1)
    return np.where(found == -32768, np.nan, ref["least"] + ref["step"] * found.astype(float))


def test_numbers_survive_packing():
    values = np.random.default_rng(0).normal(size=(7, 5)) * [1, 10, 0, 1e3, 1]
    values[3, :] = np.nan
    blob = Blob()
    blob.whole(np.arange(3))
    ref = blob.real(values, 5)
    found = numbers(b"".join(blob.parts), ref).reshape(7, 5)
    np.testing.assert_allclose(found, values, atol=0.51 * ref["step"], equal_nan=True)


def test_the_file_holds_the_motion(run, tmp_path):
    system, trajectory = run
    file = nc.view(system, trajectory, file=tmp_path / "motion.html", title="two <rods>", follow="rod 2")
    text = file.read_text("utf-8")
    assert len(text) < 200_000 and "two &lt;rods>" in text
    assert not re.search(r"(src|href)=.?(http|//)|@import|url\(|fetch\(|XMLHttp", text), "nothing is loaded"
    scene, data = scene_of(text)
    assert scene["follow"] == "rod 2" and scene["bodies"] == ["rod 1", "rod 2"] and scene["lanes"] == 1
    assert [s["name"] for s in scene["solids"] if s["kind"] == "joint"] == ["hinge 1", "hinge 2"]
    second = next(s for s in scene["solids"] if s["name"] == "rod 2")
    rows = numbers(data, second["rows"]).reshape(41, 4, 3)
    np.testing.assert_allclose(rows, np.asarray(trajectory.q)[:, 4:8], atol=2e-4)
    np.testing.assert_allclose(scene["times"], trajectory.t)


def test_surfaces_springs_forces_and_traces(sheet):
    system, trajectory = sheet
    mesh = nc.Point(nc.core.handles.Handle("body", "mesh[5]", 0), (1.0, 1.0, 0.0))
    view = motion.scenery_at(
        nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t), colour="energy", traces=[mesh]
    )
    [skin] = view.skins
    assert skin.faces.shape == (2, 4) and skin.label == "stored energy [J/m²]"
    energy = np.asarray(system.energy(trajectory).stores["plate"])
    np.testing.assert_allclose(skin.values.sum(axis=1) * 0.5, energy, rtol=1e-9, atol=1e-15)
    kinds = {s.name: s.kind for s in view.solids}
    assert kinds == {"spring": "link", "push": "force"}
    spring = next(s for s in view.solids if s.kind == "link")
    np.testing.assert_allclose(spring.rows[:, 3], np.asarray(trajectory.q)[:, 0] - (0, 0, 1), atol=1e-12) if (
        spring.rows[0, 0] == (0, 0, 1)
    ).all() else pytest.fail("the spring hangs on the ground")
    np.testing.assert_allclose(view.traces[0].points, np.asarray(trajectory.q)[:, 20], atol=1e-12)
    assert view.ground == pytest.approx(np.asarray(trajectory.q)[:, ::4, 2].min())


def test_contacts_and_motors_have_arrows():
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
    given = jnp.tile(jnp.array([3.0, -4.0, 0.5]), (8, 1))
    trajectory = nc.simulate(system, state, dt=0.01, inputs=given)
    shown = motion.scenery_at(nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t))
    arrows = {s.name: s.rows for s in shown.solids if s.kind == "force"}
    assert list(arrows) == ["push", "motor", "servo", "floor of light", "floor of heavy"]
    one, two = arrows["floor of light"], arrows["floor of heavy"]
    np.testing.assert_allclose(two[2:, 0], [[1.0, 0, 0]] * 7, atol=1e-9)
    np.testing.assert_allclose(two[2:, 3], 2 * one[2:, 3], atol=1e-9)
    assert np.all(one[2:, 3, 2] > 0) and np.abs(one[2:, 3, :2]).max() < 1e-12
    place = system.structure.bodies.index("car")
    np.testing.assert_allclose(arrows["push"][:, 0], np.asarray(trajectory.q)[:, 4 * place], atol=1e-12)
    assert np.all(arrows["push"][:, 3, 0] < 0) and np.abs(arrows["push"][:, 3, 1:]).max() < 1e-12
    # A turning arrow is as wide as it is long: 3 N m of the motor, 2 (0.5 - angle) of the servo.
    angle = np.asarray(system.sense(trajectory, hinge).angle)
    np.testing.assert_allclose(arrows["servo"][:, 3] / arrows["motor"][0, 3, 1],
                               np.outer(2 * (0.5 - angle) / 3, [0, 1, 0]), atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(np.linalg.norm(arrows["motor"][:, 1], axis=1), arrows["motor"][:, 3, 1])


def test_gaps_of_a_contact_have_one_arrow():
    """A block of rubber on the floor: one arrow, from below its middle."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rubber = nc.Elastic(E=1e6, nu=0.3, density=1000.0)
    block = scene.add(nc.Solid(nc.mesh.box((1, 1, 0.5), (1, 1, 1)), material=rubber, name="block"))
    scene.add(nc.Contact(block.face("z0"), nc.Plane(), stiffness=1e5, name="floor"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=3)
    shown = motion.scenery_at(nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t))
    [force] = [s for s in shown.solids if s.kind == "force"]
    assert force.name == "floor" and force.rows[3, 3, 2] > 0
    np.testing.assert_allclose(force.rows[1:, 0, :2], 0.5, atol=1e-9)


def momentum(system, trajectory, body):
    """Of the nodes of a solid (t, 3), without what is clamped."""
    nodes = [k for k, name in enumerate(system.structure.bodies) if name.startswith(body)]
    mass = np.asarray(system.mass)[nodes, 0, 0]
    return np.einsum("n,tnx->tx", mass, np.asarray(trajectory.states.row_rates)[:, nodes, 0])


@pytest.mark.slow
def test_nodes_on_surfaces_have_arrows_that_are_the_force_together(monkeypatch):
    """A block falls flat on another: what changes its momentum, on four nodes, and the strongest of them."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    given = {"material": rubber, "velocity": (0, 0, -2.0), "position": (0.3, 0.2, 1.001)}
    upper = scene.add(nc.Solid(nc.mesh.box((1, 0.8, 1), (1, 1, 1)), **given, name="upper"))
    lower = scene.add(nc.Solid(nc.mesh.box((2, 2, 1), (1, 1, 1)), material=rubber, name="lower"))
    contact = nc.Contact(upper.face("z0"), lower.face("z1"), one_pass=True, name="impact")
    scene.add(contact)
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=12)
    phases, times = nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t)
    largest = nc.contacts(system, trajectory).force.max()

    def arrows():
        return [s for s in motion.scenery_at(phases, times).solids if s.kind == "force"]

    shown = arrows()
    assert [s.name for s in shown] == ["impact"] * 4
    rows = np.stack([s.rows for s in shown])[:, 1:]
    there = np.isfinite(rows).all(axis=(2, 3))
    long = np.linalg.norm(rows[:, :, 3], axis=-1)
    found = np.nan_to_num(rows[:, :, 3]).sum(axis=0) * largest / long[there].max()
    wanted = np.diff(momentum(system, trajectory, "upper"), axis=0) / 2e-3
    assert wanted[:, 2].max() > 10.0 and there.any(axis=0).sum() > 5
    np.testing.assert_allclose(found, wanted, atol=0.01 * wanted.max())
    nodes = np.asarray(trajectory.states.rows)[1:, :, 0]
    apart = np.linalg.norm(nodes - rows[:, :, None, 0], axis=-1).min(axis=2)
    assert apart[there].max() < 1e-12, "an arrow that begins at no node"
    assert np.all(np.linalg.norm(rows[:, :, 1], axis=-1)[there] < 0.21 * long[there]), "discs"
    monkeypatch.setattr("natcoord_jax.viz.arrows.STRONGEST", 2)
    strongest = np.sort(np.nanmax(long, axis=1))[-2:]
    kept = [np.nanmax(np.linalg.norm(s.rows[:, 3], axis=1)) for s in arrows()]
    np.testing.assert_allclose(np.sort(kept), strongest, rtol=1e-12)


def test_forces_are_drawn_over_what_they_are_inside_of(sheet):
    """Could go wrong: one list of faces, in which those of a body hide the force of a contact below it."""
    system, trajectory = sheet
    shown = motion.scenery_at(nc.Phases((system,), (trajectory,)), np.asarray(trajectory.t))
    stage = Stage(Figure().add_subplot(projection="3d"), shown)
    stage.show(0)
    bodies, forces = stage.drawn
    assert forces.get_zorder() > bodies.get_zorder()
    count = sum(len(face) // 2 for s in shown.solids if s.kind == "force" for face in s.faces)
    assert 0 < len(stage.layers[1].at(0)[0]) <= count


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
        both = jax.tree.map(lambda x, order=order: x[jnp.array(order)], trajectory)
        nc.view(system, both, file=tmp_path / "a.html")
        shown, data = scene_of((tmp_path / "a.html").read_text("utf-8"))
        [force] = [s for s in shown["solids"] if s["kind"] == "force"]
        rows = numbers(data, force["rows"]).reshape(2, -1, 12)
        assert np.isnan(rows[k]).all() and np.isfinite(rows[1 - k]).any()


def test_values_of_elements_that_are_handed_over(sheet, tmp_path):
    system, trajectory = sheet
    nc.view(system, trajectory, file=tmp_path / "a.html", colour={"plate": [1.0, 3.0]})
    scene, data = scene_of((tmp_path / "a.html").read_text("utf-8"))
    [skin] = scene["skins"]
    assert skin["label"] == "plate" and skin["range"] == [0.0, 3.0]
    assert numbers(data, skin["values"]).reshape(-1, 2)[4] == pytest.approx([1.0, 3.0], abs=1e-3)
    with pytest.raises(ValueError, match=r"'plate' got values of shape \(3,\); pass one for each of its 2"):
        nc.view(system, trajectory, file=tmp_path / "a.html", colour={"plate": [1.0, 2.0, 3.0]})


def test_batches_are_lanes(run, tmp_path):
    system, trajectory = run
    batch = jax.tree.map(lambda x: jnp.stack([x] * 20), trajectory)
    text = nc.view(system, batch, file=tmp_path / "batch.html").read_text("utf-8")
    assert scene_of(text)[0]["lanes"] == 16
    pairs = jax.tree.map(lambda x: jnp.stack([x] * 2), batch)
    text = nc.view(system, pairs, file=tmp_path / "batch.html").read_text("utf-8")
    assert scene_of(text)[0]["lanes"] == 16


def test_phases_with_joints_that_come_and_go():
    def scene(held):
        made = nc.Scene()
        made.add(nc.Gravity())
        ball = made.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), name="ball"))
        if held:
            made.add(nc.Revolute(nc.ground, ball, point=(1, 0, 0), axis=(0, 1, 0), name="hinge"))
        return made.compile()

    system, state = scene(held=True)
    swing = nc.simulate(system, state, dt=0.01, steps=5)
    flying, state = nc.transfer(system, swing[-1], scene(False)[0])
    flight = nc.simulate(flying, state, dt=0.01, steps=5)
    phases = nc.Phases((system, flying), (swing, flight))
    shown = motion.scenery_at(phases, np.linspace(0, 0.1, 11))
    hinge = next(s for s in shown.solids if s.name == "hinge")
    assert np.isfinite(hinge.rows[:5]).all() and np.isnan(hinge.rows[6:]).all()
    assert "hinge" in nc.viz.packed.page([shown], 1.0, "")


def test_a_run_that_broke_down_is_shown_as_far_as_it_went(run, tmp_path):
    system, trajectory = run
    broken = eqx.tree_at(lambda x: x.states.q, trajectory, trajectory.q.at[20:].set(jnp.nan))
    scene, data = scene_of(nc.view(system, broken, file=tmp_path / "broken.html").read_text("utf-8"))
    rows = numbers(data, scene["solids"][0]["rows"]).reshape(41, 12)
    assert np.isfinite(rows[:20]).all() and np.isnan(rows[20:]).all() and 0 < scene["size"] < 10
    nc.animate(system, broken, file=tmp_path / "broken.gif", fps=5)


def test_what_it_refuses(run, tmp_path):
    system, trajectory = run
    with pytest.raises(ValueError, match="view needs the system and a trajectory"):
        nc.view(system)
    with pytest.raises(ValueError, match=r"ends in \.html"):
        nc.view(system, trajectory, file="motion.gif")
    with pytest.raises(ValueError, match="no body 'rod 3' to follow; there are rod 1, rod 2"):
        nc.view(system, trajectory, file=tmp_path / "a.html", follow="rod 3")


def test_from_a_script_it_says_where_the_file_is(run, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    view = nc.view(*run)
    told = capsys.readouterr().out
    file = re.search(r"open (\S+motion\.html) in a browser", told)[1]
    assert view._repr_html_().startswith("<iframe") and len(view.html) > 10_000
    assert open(file, encoding="utf-8").read() == view.html


def test_round_faces_are_smooth_and_edges_are_seen(run):
    system, trajectory = run
    shown = motion.scenery_at(nc.Phases((system,), (trajectory,)), np.zeros(1))
    rod = next(s for s in shown.solids if s.name == "rod 1")
    place, normal, shade, lines = triangles(rod)
    assert place.shape == normal.shape and len(shade) == len(place) and len(lines) > 0
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    # The mantle of a rod along x: normals at its corners point away from the axis.
    mantle = np.abs(normal[:, 0]) < 1e-9
    away = place[mantle][:, 1:] / np.linalg.norm(place[mantle][:, 1:], axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(away * normal[mantle][:, 1:], axis=1)), 1.0, atol=0.01)


def test_it_is_served_live(run, sheet, capsys):
    pytest.importorskip("viser", reason="no viser: install the extra viz3d")
    system, trajectory = run
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
    live = nc.view(*sheet, live=True)
    live.stop()


def test_without_viser_the_line_to_install_it_is_named(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r'pip install "natcoord-jax\[viz3d\]"'):
        nc.view(*run, live=True)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: install it, apt-get install chromium")
@pytest.mark.parametrize("name", ["rods", "sheet"])
def test_a_browser_shows_it_without_complaint(name, run, sheet, tmp_path):
    """Drawn at two times: something is there, it moves, and the console is silent."""
    from matplotlib.image import imread

    moving = {"rods": run, "sheet": sheet}[name]
    traces = gallery.load("double_pendulum").traces if name == "rods" else ()
    nc.view(*moving, file=tmp_path / "motion.html", title=name, traces=traces)
    pictures = []
    for place in (0.0, 0.9):
        shot = tmp_path / f"{place}.png"
        where = [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}"]
        address = f"{(tmp_path / 'motion.html').as_uri()}#{place}"
        told = subprocess.run(
            [CHROMIUM, *FLAGS, *where, address], capture_output=True, text=True, timeout=100
        )
        lines = [line for line in told.stderr.splitlines() if "CONSOLE" in line]
        assert not [line for line in lines if "GL Driver Message" not in line], lines
        pictures.append(imread(shot)[60:420, 190:, :3])
    # Bodies are far from the grey of ground and sky.
    coloured = [float((np.ptp(p, axis=2) > 0.15).mean()) for p in pictures]
    assert min(coloured) > 1e-3, f"nothing is drawn: {coloured}"
    # The path of the tip is as long as the tip has come, and not the scribble that wrong numbers would be.
    rows, columns = np.nonzero(np.abs(pictures[1] - PALETTE[3]).max(axis=2) < 0.05)
    assert name == "sheet" or (len(rows) > 1 and np.ptp(rows) < 60 and np.ptp(columns) < 30), (
        "no path, or a wrong one"
    )
    assert float((np.abs(pictures[0] - pictures[1]).max(axis=2) > 0.1).mean()) > 1e-3, "nothing moves"
