"""The tennis player: masses, the driven swing, and the impact of ball and strings in a short stroke."""

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.gallery.player import placements, swings, twist_of
from natcoord_jax.gallery.segments import MASS, SEGMENTS, TIMES
from natcoord_jax.gallery.shot import shot
from natcoord_jax.gallery.tennis import HAND, HIT, figure, stroke

matplotlib.use("agg")

INCOMING = 15.0
"""Speed of the ball [m/s]."""


def test_nineteen_bodies_have_the_mass_of_the_player():
    assert len(SEGMENTS) == 19
    assert sum(segment.mass for segment in SEGMENTS.values()) * MASS == pytest.approx(MASS, rel=1e-12)
    # Parents come first, so that one pass finds where all are.
    names = ["ground", *SEGMENTS]
    assert all(names.index(s.parent) < names.index(name) for name, s in SEGMENTS.items())


@pytest.mark.slow
def test_the_swing_goes_through_its_poses_without_jumps_of_acceleration():
    swing = swings()["right upper arm", 0]
    rate, bend = jax.grad(swing), jax.grad(jax.grad(swing))
    for time, value, slope in zip(TIMES, swing.values, swing.rates):
        for side in (-1e-9, 1e-9):
            t = jnp.clip(jnp.asarray(time + side), TIMES[0] + 1e-9, TIMES[-1] - 1e-9)
            assert float(swing(t)) == pytest.approx(float(value), abs=1e-7)
            assert float(rate(t)) == pytest.approx(float(slope), abs=1e-6)
            assert float(bend(t)) == pytest.approx(0.0, abs=1e-5)


def test_the_twist_of_the_hand_moves_its_points():
    point, step = np.array([0.0, -1.29, 1.42]), 1e-4
    speed, spin = twist_of(HAND, HIT)
    before, there, after = (placements(HIT + dt)[HAND](point) for dt in (-step, 0.0, step))
    np.testing.assert_allclose(speed + np.cross(spin, there), (after - before) / (2 * step), rtol=1e-5)
    assert there[2] > 0.5 and speed @ speed + spin @ spin > 1.0


@pytest.fixture(scope="module")
def short():
    """From 15 ms before the impact until the ball has rung off."""
    example = gallery.load("tennis", start=HIT - 0.015, end=HIT + 0.05, speed=INCOMING)
    return example, example.run()


@pytest.mark.exhaustive
def test_the_books_of_the_stroke_balance(short):
    """Energy with the work of the drives, through impact and losses; the joints hold."""
    example, run = short
    for system, part in run.pairs:
        assert nc.balance(system, part).energy.max() <= 1e-9
        assert float(system.constraint_errors(part).position.max()) <= 1e-9
    work, energy = run.work(), run.energy()
    assert sum(abs(float(w[-1])) for name, w in work.items() if "drive" in name) > 1.0
    worked = sum(np.asarray(w) for w in work.values())
    total = np.asarray(energy.total)
    np.testing.assert_allclose(total - total[0], worked, rtol=0, atol=1e-9 * np.abs(total).max())
    assert float(work["ball"][-1]) < -1.0 and np.diff(np.asarray(work["ball"])).max() <= 1e-12


@pytest.mark.exhaustive
def test_the_impact_is_as_measured(short):
    """Ball and strings touch for 4 to 5 ms at 20 to 30 m/s; no node leaves the strings that it may touch."""
    example, run = short
    seen = stroke(run, example.facts["ball"])
    closing = seen.racket[0] - seen.before[0]
    assert seen.before[0] == pytest.approx(-INCOMING, abs=1e-9) and 20.0 < closing < 30.0
    assert 4e-3 <= seen.dwell <= 5e-3
    assert 1000.0 < seen.force < 2500.0
    # Of a racket in a hand, which gives way, a ball rebounds with some 0.4 of the closing speed.
    assert 0.3 < (seen.after[0] - seen.racket[0]) / closing < 0.5


@pytest.mark.exhaustive
def test_strain_energy_jumps_at_the_impact(short):
    """Figure 10 of the paper."""
    example, run = short
    stores = run.energy().stores
    t, strain = np.asarray(run.t), sum(np.asarray(x) for name, x in stores.items() if name != "gravity 1")
    before, during = strain[t < HIT - 0.004], strain[(t > HIT) & (t < HIT + 0.005)]
    assert np.ptp(before) < 0.5 < 5.0 < during.max() - before[-1]
    assert strain[-1] - before[-1] < 0.5 * (during.max() - before[-1])
    drawn = figure(example.facts["racket"], example.facts["ball"], run)
    titles = [axes.get_title() for part in drawn.subfigs for axes in part.axes]
    assert "strain energy of racket and ball" in titles


@pytest.mark.exhaustive
def test_a_shot():
    """A swing begins where its drives are, energy is in the books, and an open face sends the ball up."""
    made, swing = shot(), jnp.array([0.5, -0.1, 0.02])
    system, state = made.started(swing)
    errors = system.constraint_errors(state)
    assert float(errors.position) <= 1e-13 and float(errors.velocity) <= 1e-12
    run = made.run(swing)
    assert nc.balance(system, run).energy.max() <= 1e-9
    assert abs(float(system.work(run)["right upper arm drive 1"][-1])) > 1.0
    force = np.asarray(system.sense(run, "impact").force).sum(axis=1)
    assert force.max() > 500.0 and force[0] == 0.0 and force[-1] == 0.0
    _, velocity = made.flight(run)
    _, level = made.flight(made.run(jnp.zeros(3)))
    assert velocity[0] > 15.0 and velocity[2] > level[2] + 1.0


@pytest.mark.exhaustive
def test_a_shot_is_aimed():
    """At a place and a speed, by derivatives through drives, racket and contact; differences confirm them."""
    made = shot()

    @nc.jit
    def slopes(swing):
        def look(swing):
            landing = made.landing(swing)
            return landing, landing

        return jax.jacfwd(look, has_aux=True)(swing)

    landing, swing = nc.jit(made.landing), jnp.array([0.0, -0.1, 0.0])
    by_swing, _ = slopes(swing)
    for k in range(3):
        change = 1e-6 * jnp.eye(3)[k]
        difference = (landing(swing + change) - landing(swing - change)) / 2e-6
        np.testing.assert_allclose(by_swing[:, k], difference, rtol=1e-6, atol=1e-6)
    # Which nodes hit which strings changes with the swing, and with it where the ball goes, by centimetres
    # of ten metres: from farther away Newton's method takes a step to and fro before it is near. For some
    # swings a step is repeated in halves; for this one none is, so that the last digits can be asked for.
    aimed, swing = jnp.array([0.6, -0.14, 0.02]), jnp.array([0.58, -0.138, 0.0198])
    target, (by_swing, landed) = landing(aimed), slopes(swing)
    for _ in range(5):
        swing = swing - jnp.linalg.solve(by_swing, landed - target)
        by_swing, landed = slopes(swing)
    np.testing.assert_allclose(landed, target, rtol=1e-9)
    np.testing.assert_allclose(swing, aimed, rtol=1e-7)
