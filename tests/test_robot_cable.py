"""The robot that mounts a cable: systems, grip, balances and pictures, with a short cable and in full."""

import json

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import cli, gallery
from natcoord_jax.gallery.robot import GRIP, LENGTH, LINKS, PLACE, WAY, mount, mounting, way

matplotlib.use("agg")

FEW = 4
"""Elements of the cable in the quick tests."""
GRAVITY = 9.81
"""[m/s^2]"""


@pytest.fixture(scope="module")
def short():
    """The run in long steps until shortly after the grip."""
    return mounting(FEW), mount(FEW, 110, 0.02)


def test_the_way_rests_at_its_points():
    for number, (time, point) in enumerate(zip((0.0, 2.0, 5.0, 7.0, 10.0, 12.0), WAY)):
        place, rate = jax.jvp(way, (jnp.asarray(time),), (jnp.ones(()),))
        np.testing.assert_allclose(place, point, rtol=0, atol=1e-14)
        np.testing.assert_allclose(rate, 0.0, rtol=0, atol=1e-12)
        assert number == 0 or np.abs(np.array(point) - WAY[number - 1]).max() > 0.1
    limits = np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 170.0])
    angles = jax.vmap(way)(jnp.linspace(0.0, 12.0, 200))
    assert np.all(np.abs(angles) < limits)


def test_links_are_bodies_with_the_inertia_of_their_size():
    for _, mass, _, (xx, yy, zz, _) in LINKS:
        assert max(xx, yy, zz) <= xx + yy + zz - max(xx, yy, zz)
        assert np.sqrt(max(xx, yy, zz) / mass) < 0.1
    assert 10.0 < sum(mass for _, mass, *_ in LINKS) < 16.0


@pytest.mark.exhaustive
def test_the_cable_hangs_at_rest_between_holder_and_clamp(short):
    parts, _ = short
    system, state = parts.approach, parts.state
    assert system.structure.multipliers == parts.gripped.structure.multipliers == 0
    middle = system.sense(state, parts.cable.at(0.5)).position
    ends = [system.sense(state, parts.cable.nodes[k]).position for k in (1, -2)]
    assert 0.005 < PLACE[2] - float(middle[2]) < 0.1
    np.testing.assert_allclose(ends[0][2], ends[1][2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(middle[1], PLACE[1] + 0.03 + LENGTH / 2, rtol=0, atol=1e-9)
    # Left alone it stays: nothing holds the robot, which is not part of the cable.
    run = nc.simulate(system, state, dt=0.02, steps=5)
    np.testing.assert_allclose(system.sense(run, parts.cable.at(0.5)).position[-1], middle, rtol=0, atol=1e-9)


@pytest.mark.exhaustive
def test_the_gripper_closes_where_the_plug_is(short):
    parts, run = short
    (approach, before), (gripped, after) = run.pairs
    assert float(after.t[0]) == float(before.t[-1]) == pytest.approx(GRIP)
    plug = approach.sense(before, "plug").position
    np.testing.assert_allclose(plug, np.broadcast_to(PLACE, plug.shape), rtol=0, atol=1e-12)
    # Angles count from the pose at the start; the way is followed to round-off of feedback.
    for trajectory in run.trajectories:
        wanted = jax.vmap(way)(trajectory.t) - jnp.asarray(WAY[0])
        np.testing.assert_allclose(trajectory.states.coordinates, wanted, rtol=0, atol=1e-9)
    assert abs(float(run.losses()[0])) < 1e-9
    offset = [
        gripped.sense(after, "plug").position - gripped.sense(after, "gripper").position,
        gripped.sense(after, "gripper").rotation,
    ]
    local = np.einsum("tji,tj->ti", offset[1], offset[0])
    np.testing.assert_allclose(local, np.broadcast_to(local[0], local.shape), rtol=0, atol=1e-12)
    assert np.linalg.norm(gripped.sense(after, "plug").position[-1] - plug[-1]) > 1e-4


@pytest.mark.exhaustive
def test_balances_and_pictures(short, tmp_path):
    parts, run = short
    for system, trajectory in run.pairs:
        assert nc.balance(system, trajectory).energy.max() < tol.ENERGY
        assert float(system.constraint_errors(trajectory).position.max()) < tol.CONSTRAINT
    energy, work = run.energy(), sum(run.work().values())
    scale = energy.kinetic + sum(abs(x) for x in energy.stores.values())
    scale = float(jnp.max(scale + sum(abs(x) for x in run.work().values())))
    error = energy.total - energy.total[0] - work + jnp.where(run.t > GRIP, run.losses()[0], 0.0)
    assert float(jnp.abs(error).max()) < 1e-9 * scale
    assert run.t.shape == (112,) and run.momentum().shape == (112, 3)
    figure = gallery.robot.figure(parts, run)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == ["t = 0 s", "t = 1 s", "t = 2 s", "energies", "strain energy of the cable"]
    curves = nc.plot(run).axes
    assert curves[0].get_title() == "energy by store"
    assert curves[0].lines[0].get_xdata().shape == (112,)
    film = nc.animate(run, file=tmp_path / "film.gif", fps=5, beams=[parts.cable])
    assert film.read_bytes()[:3] == b"GIF"


@pytest.mark.exhaustive
def test_a_jerky_grip_loses_energy(short):
    """The gripper meets the plug in motion: what is lost is what momenta cannot keep."""
    parts, run = short
    state = jax.tree.map(lambda x: x[60], run.trajectories[0].states)
    gripped, after = nc.transfer(parts.approach, state, parts.gripped)
    lost = parts.approach.energy(state).kinetic - gripped.energy(after).kinetic
    assert float(lost) > 1e-3
    assert float(gripped.constraint_errors(after).velocity) < tol.CONSTRAINT
    # Whatever hangs on the foot: only its reactions change momenta, not those about the first hinge's axis.
    turning = [s.angular_momentum(x)[2] for s, x in ((parts.approach, state), (gripped, after))]
    assert float(turning[0]) == pytest.approx(float(turning[1]), abs=1e-12)


@pytest.mark.exhaustive
def test_the_whole_run(tmp_path, monkeypatch, capsys):
    """From the command line, in the steps that the scene suggests."""
    runs, run_of = [], gallery.Example.run

    def recorded(*arguments, **options):
        runs.append(run_of(*arguments, **options))
        return runs[-1]

    monkeypatch.setattr(gallery.Example, "run", recorded)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "robot-cable", "--json", "report.json"]) == 0
    out = capsys.readouterr().out
    assert "wrote robot_cable.png" in out and "change of joints" in out
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report["steps_completed"] == 1200 and report["result"] == "successful"
    assert report["energy_error_max"] < 1e-9
    assert abs(report["energy_lost_at_changes"][0]) < 1e-9
    parts, run = mounting(), runs[-1]
    assert parts.approach.structure.solver == parts.gripped.structure.solver == "recursive"
    assert len(parts.cable.elements) == 40 and run.t.shape == (1202,)
    for system, trajectory in run.pairs:
        assert trajectory.result == 0
        assert nc.balance(system, trajectory).energy.max() < 1e-9
        wanted = jax.vmap(way)(trajectory.t) - jnp.asarray(WAY[0])
        np.testing.assert_allclose(trajectory.states.coordinates, wanted, atol=1e-7)
    energy = run.energy()
    strain = energy.potential - energy.stores["gravity"]
    assert float(strain[-1]) > 20 * float(strain[0])
    # Large deformation: the plug has turned and gone half way to the clamp.
    plug = run.systems[-1].sense(run.trajectories[-1], "plug")
    clamp = np.array(PLACE) + (0.0, 0.03 + LENGTH, 0.0)
    assert np.linalg.norm(plug.position[-1] - clamp) < 0.5 * LENGTH
    # From rest to rest: the cable hardly swings at the end.
    assert float(energy.kinetic[-1]) < 0.05 * float(energy.kinetic.max())
    figure = gallery.robot.figure(parts, run)
    assert sum(axes.get_title().startswith("t =") for axes in figure.axes) == 8
