"""Roots that are found inside: laws, unknowns of elements, starts, equilibria and frequencies.

What could go wrong: a root is right and its derivatives are those of one step of Newton's method, right once
and wrong after that; a projection has another metric than that of the mass; a joint is closed in a pose that
is none of its own; a search ends on another branch without a word.
"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import STEPS

import natcoord_jax as nc


def derivatives(f, count=3):
    """Value and derivatives by a number, each made of the one before, forward over reverse."""
    every = [f, jax.grad(f)]
    for _ in range(count - 1):
        every.append(lambda x, g=every[-1]: jax.jvp(g, (x,), (1.0,))[1])
    return lambda x: jnp.stack([g(x) for g in every])


def assert_derivatives(f, points, sizes, count=3):
    """Each against differences of the one before, at the best of several steps; one program.

    Args:
        f: function of a number.
        points: where.
        sizes: over which it changes there.
        count: of derivatives.

    Returns:
        Value and derivatives at each of the points.
    """
    points, sizes = (jnp.asarray(x, float)[:, None] for x in (points, sizes))
    steps = sizes * STEPS[:10]
    lanes = jnp.stack([points + sign * steps for sign in (0.0, 1.0, -1.0)])
    every = jax.jit(jax.vmap(derivatives(f, count)))(lanes.reshape(-1)).reshape(*lanes.shape, -1)
    at, ahead, behind = np.asarray(every)
    misses = np.abs((ahead - behind)[..., :-1] / (2 * steps)[..., None] - at[..., 1:]).min(axis=1)
    powers = np.asarray(sizes) ** np.arange(count + 1.0)
    scale = np.max(np.abs(at[:, 0]) * powers, axis=1, keepdims=True) / powers[:, 1:]
    assert np.all(misses <= tol.DIFFERENCE_BEST * scale), (misses, at[:, 0])
    return at[:, 0]


# --- laws and elements --------------------------------------------------------------------------------------


def test_the_damping_of_a_restitution():
    """The root of (1 + d) / (1 - e d) = exp(d (1 + e)): of what hardly rebounds to what loses none."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 0.2)))
    scene.add(nc.Contact(ball, nc.Plane(), stiffness=2e4, restitution=0.5, speed=2.0, name="bounce"))
    system, _ = scene.compile()

    def damping(e):
        return system.set("bounce", restitution=e).get("bounce", "damping")

    points = np.array([0.02, 0.5, 0.95])
    found = assert_derivatives(damping, points, (2e-3, 0.1, 0.03), count=2)
    d = 2.0 * found[1:, 0]
    np.testing.assert_allclose(
        np.log1p(d) - d * (1 + points[1:]), np.log1p(-points[1:] * d), rtol=tol.EXACT_GRADIENT
    )
    gaps = np.array([2.0**-20, 2.0**-30, 2.0**-40, 0.0])
    near = np.array([float(damping(1.0 - gap)) for gap in gaps])
    np.testing.assert_allclose(near, 0.75 * (gaps + gaps**2), atol=np.finfo(float).eps ** 1.1)
    assert np.all(near[:-1] > 0) and near[-1] == 0


class Series(nc.MixedPotential):
    """A linear and a stiffening spring one after the other; of its own is how far the first one is drawn."""

    stiffness: Any = eqx.field(kw_only=True)
    unknowns = 1

    def invariants(self, x):
        """Squared distance."""
        return ((x[1] - x[0]) @ (x[1] - x[0]))[None]

    def mixed_energy(self, invariants, drawn):
        """Of both."""
        other = jnp.sqrt(invariants[0]) - drawn[0]
        return 0.5 * self.stiffness * drawn[0] ** 2 + 0.25 * other**4 + 0.5 * other**2


@pytest.mark.slow
def test_unknowns_of_an_element():
    """And its energy, by a stiffness of it."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1.5, 0, 0)))
    scene.add(Series((nc.Point(nc.ground), nc.Point(ball)), stiffness=2.0, name="two"))
    system, state = scene.compile()

    def both(stiffness):
        shown = system.set("two", stiffness=stiffness).sense(state, "two")
        return shown.own[0] + shown.energy

    assert_derivatives(both, [2.0], [1.0])


# --- frequencies --------------------------------------------------------------------------------------------


@cache
def ball_on_springs():
    """A mass on a spring of no length, 4 N/m in all directions, and one along (0, 1, 1) / sqrt 2."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0)))
    at = nc.Point(ball, (1, 0, 0))
    scene.add(nc.Spring((nc.Point(nc.ground, (1, 0, 0)), at), stiffness=4.0, name="all"))
    ends = nc.Point(nc.ground, (1, 1, 1)), at
    scene.add(nc.Spring(ends, stiffness=0.0, length=2**0.5, name="one"))
    system, state = scene.compile()

    def frequencies(every, one):
        changed = system.set("all", stiffness=every).set("one", stiffness=one)
        return nc.modes(changed, state, damped=False).frequencies

    return frequencies


@pytest.mark.slow
def test_frequencies_that_coincide():
    """Derivatives where they have some; none, not those of their mean, where a change splits them."""
    frequencies = ball_on_springs()

    def mean_square(every, one):
        return jnp.mean(frequencies(every, one) ** 2)

    @jax.jit
    def answers(every, one):
        alike, split = (jax.jvp(frequencies, (every, one), d)[1] for d in ((1.0, 0.0), (0.0, 1.0)))
        backward = jax.grad(lambda x: frequencies(every, x)[0])(one)
        return alike, split, backward, jax.grad(mean_square, argnums=(0, 1))(every, one)

    alike, split, backward, means = answers(4.0, 0.0)
    np.testing.assert_allclose(alike, 0.25, rtol=tol.EXACT_GRADIENT)
    assert np.all(np.isnan(split)) and np.isnan(backward)
    np.testing.assert_allclose(means, (1.0, 1 / 3), rtol=tol.EXACT_GRADIENT)
    _, split, _, _ = answers(4.0, 0.5)
    np.testing.assert_allclose(split, (0, 0, 0.5 / 4.5**0.5), atol=tol.EXACT_GRADIENT)
    # A root has no derivative at zero but where it stays there.
    alike, split, _, _ = answers(0.0, 1.0)
    np.testing.assert_allclose(alike, (np.nan, np.nan, 0.5), rtol=tol.EXACT_GRADIENT)
    np.testing.assert_allclose(split, (0, 0, 0.5), atol=tol.EXACT_GRADIENT)


@pytest.mark.exhaustive
def test_second_derivatives_of_frequencies_that_coincide():
    """And that an eager call says what is missing."""
    frequencies = ball_on_springs()

    def bend(x, one):
        return jax.jvp(lambda x: jax.jvp(lambda y: frequencies(y, one), (x,), (1.0,))[1], (x,), (1.0,))[1]

    np.testing.assert_allclose(jax.jit(bend)(4.0, 0.0), -1 / 32, rtol=tol.EXACT_GRADIENT)
    assert_derivatives(lambda x: frequencies(4.0, x)[2], [0.5], [0.3])
    with pytest.raises(nc.DerivativeError, match="coincide"):
        jax.grad(lambda x: frequencies(4.0, x)[0])(0.0)


@pytest.mark.slow
def test_damped_frequencies():
    """By the damper that couples two of them, which have no derivative by differences alone."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 0)))
    at = nc.Point(ball, (0, 0, 0))
    for k, axis in enumerate(np.eye(3)):
        scene.add(nc.Spring((nc.Point(nc.ground, 2 * axis), at), stiffness=k + 1.0, length=2.0))
    scene.add(nc.Damper((nc.Point(nc.ground, (1, 1, 0.5)), at), damping=0.3, name="damper"))
    system, state = scene.compile()

    def shown(damping):
        modes = nc.modes(system.set("damper", damping=damping), state, damped=True)
        return (modes.frequencies + 2.0 * modes.damping) @ jnp.arange(1.0, 4.0)

    assert_derivatives(shown, [0.3], [0.1])


@cache
def rod_on_a_spring():
    """A rod of 1 kg whose hinge has a spring, under its weight: stiffness to angle and frequency."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.25), com=(0.5, 0, 0)))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0)))
    scene.add(nc.JointSpring(hinge, stiffness=8.0, name="spring"))
    system, state = scene.compile()

    def rest(stiffness):
        changed = system.set("spring", stiffness=stiffness)
        return changed, nc.equilibrium(changed, state, steps=1).state

    return rest


def exact_rod(stiffness):
    """k a = m g l cos a, and omega^2 = (k + m g l sin a) / I."""
    moment, angle = 9.81 * 0.5, jnp.asarray(0.5)
    for _ in range(8):
        missing = stiffness * angle - moment * jnp.cos(angle)
        angle = angle - missing / (stiffness + moment * jnp.sin(angle))
    return jnp.stack([angle, jnp.sqrt((stiffness + moment * jnp.sin(angle)) / 0.45)])


@pytest.mark.exhaustive
def test_an_equilibrium_and_the_frequency_about_it():
    """By a stiffness, the pose following: against the closed form, whose weight is most of the stiffness."""
    rest = rod_on_a_spring()

    def both(stiffness):
        changed, still = rest(stiffness)
        frequency = nc.modes(changed, still, count=1, damped=False).frequencies
        return jnp.concatenate([still.coordinates, frequency])

    # One number of both, so that one program has all.
    found = jax.jit(derivatives(lambda x: both(x) @ jnp.array([1.0, 2.0]), count=2))(8.0)
    exact = derivatives(lambda x: exact_rod(x) @ jnp.array([1.0, 2.0]), count=2)(8.0)
    np.testing.assert_allclose(found, exact, rtol=tol.DIFFERENCE_BEST)


@pytest.mark.slow
def test_an_equilibrium_by_a_stiffness():
    """Not by an approximate matrix: without the stiffness of the weight it is off by a hundredth."""
    rest = rod_on_a_spring()
    value, slope = jax.jvp(lambda x: rest(x)[1].coordinates[0], (8.0,), (1.0,))
    exact = jax.jvp(lambda x: exact_rod(x)[0], (8.0,), (1.0,))
    np.testing.assert_allclose((value, slope), exact, rtol=tol.EXACT_GRADIENT)


# --- starts -------------------------------------------------------------------------------------------------


def spinning(join, inertia=(1e-3, 0.5, 0.5), other=(1e-3, 1e-3, 1e-3), **more):
    """A shaft that spins at 10 rad/s and a ball at rest, joined."""
    scene = nc.Scene()
    velocity = (10.0, 0, 0)
    shaft = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, angular_velocity=velocity, name="shaft"))
    ball = scene.add(nc.RigidBody(mass=1.0, inertia=other, name="ball", **more))
    join(scene, shaft, ball)
    return scene


def weld(scene, shaft, ball):
    scene.add(nc.Fixed(shaft, ball))


@pytest.mark.filterwarnings("ignore:initial velocities")
def test_starts_are_projected_in_the_metric_of_the_mass():
    """However slender: what two bodies have of angular momentum is kept, whichever way they are joined."""
    for inertia, exact in (((1e-3, 0.5, 0.5), 5.0), ((1e-6, 0.5, 0.5), 10 / 1001), ((0.0, 0.5, 0.5), 0.0)):
        scene = spinning(weld, inertia)
        for assemble in (False, True):
            system, state = scene.compile(assemble=assemble)
            spin = system.sense(state, "shaft").angular_velocity
            np.testing.assert_allclose(spin, (exact, 0, 0), rtol=tol.SAME_SOLUTION, atol=tol.SAME_SOLUTION)
            turning = system.angular_momentum(state)
            np.testing.assert_allclose(
                turning, (10 * inertia[0], 0, 0), rtol=tol.SAME_SOLUTION, atol=tol.SAME_SOLUTION
            )


@pytest.mark.filterwarnings("ignore:initial velocities")
def test_a_redundant_loop_of_rods_is_projected_to_round_off():
    """Planar, with hinges that depend on each other and rods whose spin moves no mass."""
    scene = nc.Scene()
    places, moments = ((0, 0, 0), (0, 1, 0), (2, 0, 0)), ((0.1, 0, 0.1), (0, 0.1, 0.1), (0.2, 0.3, 0.2))
    one, two, three = (
        scene.add(
            nc.RigidBody(mass=1.0, inertia=moment, position=place, angular_velocity=(0.3, -0.5, k + 1.0))
        )
        for k, (place, moment) in enumerate(zip(places, moments))
    )
    hinges = (nc.ground, one, (0, 0, 0)), (one, two, (0, 1, 0)), (two, three, (2, 1.5, 0))
    for parent, child, point in (*hinges, (nc.ground, three, (2, 0, 0))):
        scene.add(nc.Revolute(parent, child, point=point))
    system, state = scene.compile()
    assert len(system.structure.redundant) > 0
    assert system.constraint_errors(state).velocity.max() <= tol.CONSTRAINT
    assert float(jnp.abs(state.v).max()) > 0.1


def spit(inertia, size, axes):
    """Two hinged bodies and a rod that is welded between them: it could spin on a hinge along itself."""
    scene, along = nc.Scene(), np.outer(axes[0], axes[0]) * size**2 / 12
    plump: dict[str, Any] = {"mass": 1.0, "inertia": 0.1 * size**2 * np.eye(3)}
    moments = np.trace(along) * np.eye(3) - along + inertia * along
    base = scene.add(nc.RigidBody(**plump))
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=moments, position=0.5 * size * axes[0]))
    end = scene.add(nc.RigidBody(**plump, position=size * axes[0]))
    hinges = (nc.ground, base, axes[1]), (base, rod, axes[0]), (base, end, axes[2])
    for parent, child, axis in hinges:
        scene.add(nc.Revolute(parent, child, point=(0, 0, 0), axis=axis))
    scene.add(nc.Fixed(rod, end))
    return scene.compile()


@pytest.mark.slow
def test_an_inertia_of_rounding_is_none():
    """Velocities against a weld are projected as those of a rod with a little inertia about its axis."""
    pushed = np.random.default_rng(1).normal(size=(3, 3))
    for size in (1e-4, 1.0):
        axes, found = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0], []
        for inertia in (0.0, 1e-9):
            system, state = spit(inertia, size, axes)
            state = eqx.tree_at(lambda s: s.v, state, state.v.at[::4].add(size * pushed))
            found.append(np.asarray(nc.assemble(system, state).v[4::4]) / size)
        assert np.abs(found[0]).max() > 1e-2
        np.testing.assert_allclose(found[0], found[1], atol=1e-8)


def test_rotors_count_in_the_metric_of_the_mass():
    """Two wheels with a gear between them, one with a rotor: (I + J) 10 = (2 I + J) rate."""

    def geared(inertia):
        scene = nc.Scene()
        options: dict[str, Any] = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0)}
        one = scene.add(nc.RigidBody(**options, angular_velocity=(0, 0, 10.0)))
        other = scene.add(nc.RigidBody(**options, position=(5, 0, 0)))
        hinges = tuple(scene.add(nc.Revolute(nc.ground, body)) for body in (one, other))
        scene.add(nc.Coupling(hinges))
        scene.add(nc.Armature(hinges[0], inertia=inertia))
        return hinges, scene

    for inertia in (0.0, 1.0, 10.0):
        hinges, scene = geared(inertia)
        with pytest.warns(UserWarning, match="were projected"):
            system, state = scene.compile()
        exact = (1.0 + inertia) * 10.0 / (2.0 + inertia)
        rates = [float(system.rate(state, hinge)) for hinge in hinges]
        np.testing.assert_allclose([*rates, *state.rates], exact, rtol=tol.STEP_BALANCE)


FACING = {
    "fixed": nc.Fixed,
    "revolute": nc.Revolute,
    "cylindrical": nc.Cylindrical,
    "prismatic": nc.Prismatic,
    "planar": nc.Planar,
    "screw": nc.Screw,
}
"""Joints whose axes point the same way."""


@pytest.mark.parametrize(
    "name", ["fixed", *(pytest.param(n, marks=pytest.mark.slow) for n in FACING if n != "fixed")]
)
def test_joints_close_facing_the_way_they_were_built(name):
    """From any start, the opposite one included; products of directions vanish upside down as well."""
    scene, axis = nc.Scene(), np.array([0.0, 0.6, 0.8])
    body: dict[str, Any] = {"mass": 1.0, "inertia": (0.1, 0.2, 0.3)}
    first, second = (scene.add(nc.RigidBody(**body, position=(x, 0, 0), name=f"{x}")) for x in (0, 1))
    scene.add(nc.Spherical(nc.ground, first))
    scene.add(nc.Spherical(first, second, point=(1, 0, 0)))
    scene.add(FACING[name](nc.ground, second, point=(1, 0, 0), axis=axis))
    system, state = scene.compile()
    for degrees in (60.0, 100.0, 150.0, 179.0, 180.0):
        turned = nc.RigidBody(**body, orientation=((1.0, 2.0, -0.5), np.radians(degrees))).rotation
        start = eqx.tree_at(lambda s: s.q, state, (state.rows @ jnp.asarray(turned).T).reshape(-1, 3))
        assembled = nc.assemble(system, start)
        rotation = system.sense(assembled, "1").rotation
        assert axis @ rotation @ axis == pytest.approx(1.0, abs=tol.SAME_SOLUTION)
        assert system.constraint_errors(assembled).position.max() <= 1e-8
        if name in ("fixed", "prismatic"):
            np.testing.assert_allclose(rotation, np.eye(3), atol=1e-8)


# --- branches -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_equilibrium_that_snaps_through_says_so():
    """Two bars that lean on each other carry 2 k s (h / s)^3 / 3^1.5 nearly; beyond, they hang."""
    scene = nc.Scene()
    top = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 0.2)))
    tip = nc.Point(top, (0, 0, 0.2))
    for x in (-1.0, 1.0):
        spring = {"stiffness": 1e3, "length": np.hypot(1.0, 0.2)}
        scene.add(nc.Spring((nc.Point(nc.ground, (x, 0, 0)), tip), **spring))
    guide = nc.Point(nc.ground, (0, 5.0, 0.2))
    scene.add(nc.Spring((guide, tip), stiffness=10.0, length=5.0))
    scene.add(nc.PointForce((tip,), force=lambda t: jnp.array([0.0, 0.0, -1.0]) * t))
    system, state = scene.compile()
    with pytest.warns(UserWarning, match=r"left the path at the load parameter 4\b.*snap=False"):
        found = nc.equilibrium(system, state, 6.0, steps=6)
    assert found.snapped.tolist() == [False, False, False, True, False, False]
    height = np.asarray(found.states.q)[:, 0, 2]
    assert np.all(height[:3] > 0.1) and np.all(height[3:] < -0.1) and np.all(found.result == 0)
    ended = nc.equilibrium(system, state, 6.0, steps=6, snap=False, throw=False)
    assert ended.result.tolist() == [0, 0, 0] + [nc.Result.DIVERGED] * 3
    with pytest.raises(nc.SimulationError, match=r"load parameter 4 .*nc\.load_path"):
        nc.equilibrium(system, state, 6.0, steps=6, snap=False)
