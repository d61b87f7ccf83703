"""Laws, norms and quotients where they are singular or out of range: value and two derivatives.

At lengths of zero, at rest, at stops, where a law decays to 1e-260, derivatives must be right or be said to
be none. Everything is held against differences, which know nothing of branches.
"""

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import STEPS, difference_errors

import natcoord_jax as nc
from natcoord_jax.control import costates
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.core.handles import Handle
from natcoord_jax.effects.springs.point_springs import COINCIDENT, energy_of_distance
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import positive_part, quotient, safe_divide, safe_norm, unit
from natcoord_jax.stepping.linear_iteration import ROUNDS, LinearIteration

SCHEMES = {order: nc.EnergyMomentum(order=order) for order in (2, 4)}


def assert_near_differences(f, x, direction, exact, size):
    """A derivative along a direction is what differences tell, to what they can, beside a size."""
    ends = [(f(x + step * direction), f(x - step * direction), step) for step in STEPS]
    missing = [np.max(np.abs((ahead - behind) / (2 * step) - exact)) for ahead, behind, step in ends]
    assert np.min(missing) <= tol.DIFFERENCE_BEST * size, missing  # of what is not finite, nothing is


def assert_two_derivatives(f, x, direction):
    """Gradient and second derivatives of a scalar function along a direction, in every mode."""
    slope = jax.grad(f)
    ahead, bent = jax.jvp(f, (x,), (direction,))[1], jax.jvp(slope, (x,), (direction,))[1]
    back = jnp.vdot(slope(x), direction)
    size = abs(float(ahead)) + float(jnp.max(jnp.abs(bent)))
    assert abs(back - ahead) <= tol.SAME_GRADIENT * size
    if abs(ahead) > 0:
        assert_near_differences(f, x, direction, ahead, size)
    assert_near_differences(slope, x, direction, bent, size)


# --- vectors ----------------------------------------------------------------------------------------------

SIZES = (1e-300, 1e-200, 1e-160, 1.0, 1e150, 1e200)


@pytest.mark.parametrize("size", SIZES)
def test_norms_and_units_neither_underflow_nor_overflow(size):
    a = size * jnp.array([3.0, 4.0, 12.0])
    assert np.isclose(safe_norm(a) / size, 13.0, rtol=tol.IDENTITY)
    assert np.allclose(unit(a), np.array([3.0, 4.0, 12.0]) / 13.0, rtol=tol.IDENTITY)
    assert np.allclose(jax.grad(safe_norm)(a), np.array([3.0, 4.0, 12.0]) / 13.0, rtol=tol.IDENTITY)
    along = jnp.array([1.0, 0.0, 0.0])
    turning = jax.jvp(unit, (a,), (size * along,))[1]
    assert np.allclose(turning, (along - 3 / 13 * a / (13 * size)) / 13.0, rtol=tol.IDENTITY)


def test_a_norm_has_no_slope_at_the_origin():
    nothing = jnp.zeros(3)
    assert float(safe_norm(nothing)) == 0.0 and not np.any(jax.grad(safe_norm)(nothing))


@pytest.mark.parametrize("size", SIZES)
def test_quotients_do_not_square_what_they_divide_by(size):
    """a / b, and its two derivatives by b, for a of the size of b; forward over reverse and the other way."""
    b = jnp.asarray(2.0 * size)

    def share(s):
        return quotient(size, b * s)

    def pushed(s):
        return jax.jvp(share, (s,), (1.0,))[1]

    found = share(1.0), jax.grad(share)(1.0), jax.jvp(jax.grad(share), (1.0,), (1.0,))[1]
    assert np.allclose((*found, jax.grad(pushed)(1.0)), (0.5, -0.5, 1.0, 1.0), rtol=tol.IDENTITY)


def test_a_quotient_by_zero_is_zero_with_all_its_derivatives():
    assert float(safe_divide(1.0, 0.0)) == 0.0
    assert [float(x) for x in jax.grad(safe_divide, (0, 1))(1.0, 0.0)] == [0.0, 0.0]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0316, 0.0317, 1.0, np.pi])
def test_rotations_are_smooth_in_their_vector(angle):
    """Three derivatives at zero and on both sides of where the series ends."""
    vector = angle / 3.0 * jnp.array([1.0, 2.0, 2.0])
    direction = jnp.array([0.3, -0.8, 0.5])

    def along(s):
        return from_rotation_vector(vector + s * direction)

    f = along
    for _ in range(3):
        f = jax.jacfwd(before := f)
        assert np.min(difference_errors(before, 0.0, 1.0, f(0.0))) <= tol.DIFFERENCE_BEST


# --- springs between points -------------------------------------------------------------------------------

EVEN_LAWS = {
    "linear": lambda d: 1.5 * d**2,
    "hardening": lambda d: jnp.cosh(3.0 * d),
    "softening": lambda d: 1.0 - jnp.cos(d),
    "quartic": lambda d: 2.0 * d**2 + d**4,
}
DISTANCES = (0.0, 1e-17, 0.9 * COINCIDENT, 1e-9, 1e-3, 0.7)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("law", EVEN_LAWS.values(), ids=list(EVEN_LAWS))
def test_even_laws_are_smooth_where_points_coincide(law, distance):
    """Against the same law of three components, which has no root: along and across the connecting line."""
    away = distance * jnp.array([0.6, 0.0, 0.8])
    energy = jax.jit(lambda u: energy_of_distance(law, jnp.sum(u * u)))
    for direction in (jnp.array([0.6, 0.0, 0.8]), jnp.array([0.0, 1.0, 0.0])):
        assert_two_derivatives(energy, away, direction)
    stiffness = float(jax.hessian(law)(distance))
    across = float(jax.grad(law)(distance)) / distance if distance > 1e-6 else float(jax.hessian(law)(0.0))
    found = np.linalg.eigvalsh(jax.hessian(energy)(away))
    assert np.allclose(found, np.sort([stiffness, across, across]), rtol=tol.EXACT_GRADIENT)


@pytest.mark.parametrize("length", [0.0, 0.3])
def test_derivatives_by_the_length_of_a_spring(length):
    """The unstretched length is a number like others: zero is not another program."""
    ends = nc.Point(nc.ground), nc.Point(nc.ground, (0.0, 0.0, 1.0))

    def energy(length, square):
        return nc.Spring(ends, stiffness=5.0, length=length).energy(jnp.asarray(square)[None])

    assert float(jax.grad(energy)(length, 0.49)) == pytest.approx(-5.0 * (0.7 - length))
    slope = jax.grad(energy, argnums=1)
    assert float(slope(length, 0.49)) == pytest.approx(2.5 * (1 - length / 0.7), rel=tol.INDIFFERENCE)
    assert float(slope(length, 0.0)) == pytest.approx(2.5)
    assert float(energy(length, 0.0)) == pytest.approx(2.5 * length**2)
    assert float(energy(length, -1e-9)) - float(energy(length, 0.0)) == pytest.approx(-2.5e-9, abs=1e-15)


def test_laws_without_second_derivative_at_zero_keep_their_force():
    """Hertz' law: continuous force, infinite stiffness; what is made of it must not be larger than that."""
    for distance in (0.0, 1e-16, 1e-13):
        pull = jax.grad(lambda u: energy_of_distance(lambda d: d**1.5, u * u))(distance)
        assert 0.0 <= float(pull) <= 1.5 * distance**0.5


# --- laws of coordinates ----------------------------------------------------------------------------------


@pytest.mark.parametrize("coordinate", [-0.3, -1e-9, 1e-9, 0.4])
def test_stops_on_both_sides(coordinate):
    stops = nc.JointStops(Handle("joint", "joint", 1), lower=-jnp.inf, upper=0.0, stiffness=9.0)
    found = [f(coordinate) for f in (stops.energy, jax.grad(stops.energy), jax.hessian(stops.energy))]
    beyond = max(coordinate, 0.0)
    assert np.allclose(found, [4.5 * beyond**2, 9.0 * beyond, 9.0 * (coordinate > 0)], rtol=tol.IDENTITY)


def test_at_the_stop_derivatives_are_those_before_contact():
    joint = Handle("joint", "joint", 1)
    for stops in (
        nc.JointStops(joint, upper=0.2, stiffness=9.0),
        nc.JointStops(joint, lower=0.2, stiffness=9.0),
    ):
        assert [float(f(0.2)) for f in (jax.grad(stops.energy), jax.hessian(stops.energy))] == [0.0, 0.0]
    assert float(jax.grad(positive_part)(0.0)) == 0.0


# --- averaged gradients -----------------------------------------------------------------------------------

LAWS = {
    "smooth": lambda p: jnp.sum(jnp.cosh(p)) + p[0] * p[1] ** 3,
    "stop": lambda p: jnp.sum(positive_part(p - 0.35) ** 2),
    "root": lambda p: jnp.sum(jnp.sqrt(p + 2.0)),
    "soft": lambda p: jnp.sum((0.05 * jax.nn.softplus(p / 0.05)) ** 2),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
@pytest.mark.parametrize("stages", [1, 2])
def test_averaged_gradients_scale_with_the_energy(stages, law):
    """Value, forward and reverse derivatives, and products with second ones, as of an energy of size one."""
    tableau, rng = gauss(stages), np.random.default_rng(stages)
    given = jnp.array([0.3, -0.2]), 0.4 * jnp.asarray(rng.normal(size=(stages, 2)))
    moved = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), given)
    weights = jnp.asarray(rng.normal(size=(stages, 2)))

    @jax.jit
    def everything(scale):
        def gradient(start, steps):
            return averaged_gradient(lambda p: scale * law(p), start, steps, tableau, None) / scale

        def worth(given):
            return jnp.vdot(weights, gradient(*given))

        ahead = jax.jvp(gradient, given, moved)
        return ahead, jax.grad(worth)(given), jax.jvp(jax.grad(worth), (given,), (moved,))[1]

    known = jax.tree.leaves(everything(1.0))
    for scale in (1e-290, 1e-260, 1e-160, 1e150):
        for one, other in zip(known, jax.tree.leaves(everything(scale)), strict=True):
            assert np.max(np.abs(one - other)) <= tol.EXACT_GRADIENT * np.max(np.abs(one)), scale


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
def test_hardly_moved_invariants_have_derivatives(law):
    """Steps of nothing: the gradient at the middle, and half the curvature."""

    @jax.jit
    def derivatives(start, steps):
        return jax.jacrev(lambda a, b: averaged_gradient(law, a, b, gauss(1), None), (0, 1))(start, steps)

    for size in (0.0, 1e-300, 1e-160, 1e-12):
        start, steps = jnp.array([0.3, -0.2]), size * jnp.array([[1.0, 0.5]])
        by_start, by_steps = derivatives(start, steps)
        curvature = jax.hessian(law)(start)
        assert np.allclose(by_start[0], curvature, rtol=1e-6, atol=1e-12)
        assert np.allclose(by_steps[0, :, 0], 0.5 * curvature, rtol=1e-6, atol=1e-12)


# --- rollouts ---------------------------------------------------------------------------------------------


def slide():
    """A slide at 0.3 m before a soft stop, whose energy is 1e-260 J there, or on its way into one."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    joint = scene.add(nc.Prismatic(nc.ground, body, axis=(1, 0, 0)))
    scene.add(nc.JointPotential(joint, law=lambda c: 5e3 * (1e-3 * jax.nn.softplus(c / 1e-3)) ** 2))
    scene.add(nc.JointDamper(joint, damping=0.5))
    system, state = scene.compile()

    def start(x):
        return system.with_coordinate(state, joint, x[0], rate=x[1])

    return system, start, [(-0.3, 0.0), (-0.3, 1.0), (-0.008, 1.0)]


def mount():
    """A point mass on mounts of no length, one of them hardening, at rest in them and beside."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=2.0))
    ends = nc.Point(nc.ground), nc.Point(ball)
    scene.add(nc.Spring(ends, stiffness=50.0))
    scene.add(nc.NonlinearSpring(ends, law=lambda d: 25.0 * d**2 + 40.0 * d**4))
    system, state = scene.compile()

    def start(x):
        return replace_fields(state, q=state.q.at[0, 0].add(x[0]), v=state.v.at[0, 2].add(x[1]))

    return system, start, [(0.0, 0.0), (0.0, 0.5), (1e-9, 0.0), (0.2, 0.5)]


SCENES = {"soft stop": slide, "mount": mount}


def end_of(scene, order):
    """What a few steps make of a start: a function of two numbers, and where to look at it."""
    system, start, points = scene()

    def end(x):
        run = nc.simulate(system, start(x), dt=0.01, steps=3, scheme=SCHEMES[order], throw=False)
        return 10.0 * run.q[-1, 0, 0] + run.v[-1, 0, 2] + run.v[-1, 0, 0]

    return end, points


CASES = [
    pytest.param(scene, order, id=f"{name}-{order}", marks=[pytest.mark.exhaustive] if order > 2 else [])
    for name, scene in SCENES.items()
    for order in SCHEMES
]

SECOND = [
    pytest.param(
        scene, order, id=f"{name}-{order}", marks=pytest.mark.exhaustive if order > 2 else pytest.mark.slow
    )
    for name, scene in SCENES.items()
    for order in SCHEMES
]


@pytest.mark.parametrize(("scene", "order"), CASES)
def test_rollouts_from_special_points(scene, order):
    """Reverse and forward derivatives of a few steps, against differences."""
    end, points = end_of(scene, order)
    value, slope = jax.jit(end), jax.jit(jax.grad(end))
    ahead = jax.jit(lambda x, d: jax.jvp(end, (x,), (d,))[1])
    direction = jnp.array([0.6, 0.8])
    for point in points:
        x = jnp.array(point)
        forward = float(ahead(x, direction))
        assert abs(float(slope(x) @ direction) - forward) <= tol.SAME_GRADIENT * abs(forward), point
        assert np.min(difference_errors(value, x, direction, forward)) <= tol.DIFFERENCE_BEST, point


@pytest.mark.parametrize(("scene", "order"), SECOND)
def test_second_derivatives_of_rollouts_at_special_points(scene, order):
    """Forward over reverse, against differences of the gradient."""
    end, points = end_of(scene, order)
    slope, direction = jax.jit(jax.grad(end)), jnp.array([0.6, 0.8])
    bent = jax.jit(lambda x: jax.jvp(jax.grad(end), (x,), (direction,))[1])
    for point in points:
        x = jnp.array(point)
        exact, size = bent(x), np.max(np.abs(slope(x)))
        assert_near_differences(slope, x, direction, exact, size + np.max(np.abs(exact)))


# --- what depends on second derivatives --------------------------------------------------------------------


def test_modes_of_a_body_on_springs_of_no_length():
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.2, 0.3)))
    for place in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        scene.add(nc.Spring((nc.Point(nc.ground, place), nc.Point(body, place)), stiffness=50.0))
    found = np.sort(nc.modes(*scene.compile()).frequencies)
    turning = np.sqrt([100.0 / 0.1, 100.0 / 0.2, 200.0 / 0.3])
    assert np.allclose(found, np.sort([10.0, 10.0, 10.0, *turning]), rtol=tol.EXACT_GRADIENT)


def test_modes_of_a_point_mass_between_springs():
    """Along sqrt(2 k / m), across sqrt(2 k / m (1 - L / d)); its directors do not turn, and are no modes."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0)))
    for end in ((0, 0, 0), (2, 0, 0)):
        scene.add(nc.Spring((nc.Point(nc.ground, end), nc.Point(ball, (1, 0, 0))), stiffness=3.0, length=0.5))
    system, state = scene.compile()
    for damped in (False, True):
        found = nc.modes(system, state, damped=damped)
        assert np.allclose(found.frequencies, np.sqrt([3.0, 3.0, 6.0]), rtol=tol.INDIFFERENCE)
        assert not np.any(found.shapes[:, 1:])
    scene.add(nc.Gravity())
    system, state = scene.compile()
    sagged = nc.equilibrium(system, state).state
    depth = -float(sagged.q[0, 2])
    length = np.hypot(1.0, depth)
    assert 6.0 * (length - 0.5) * depth / length == pytest.approx(9.81, rel=tol.EXACT_GRADIENT)
    found = np.sort(nc.modes(system, sagged).frequencies ** 2)
    sideways = 6.0 * (1 - 0.5 / length)
    both = 6.0 * (1 - 0.5 / length + 0.5 * np.array([1.0, depth**2]) / length**3)
    assert np.allclose(found, np.sort([sideways, *both]), rtol=tol.EXACT_GRADIENT)


def test_modes_of_a_point_mass_on_a_joint():
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -10.0)))
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, -2.0)))
    scene.add(nc.Distance(nc.ground, ball, point=(0, 0, -2.0)))
    assert np.allclose(nc.modes(*scene.compile()).frequencies, np.sqrt([5.0, 5.0]), rtol=tol.EXACT_GRADIENT)


# --- what is singular is said to be ------------------------------------------------------------------------


def test_a_rod_without_length_is_refused():
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0))
    scene.add(nc.Distance(nc.ground, ball, point=(0, 0, 0), name="rod"))
    with pytest.raises(ValueError, match=r"'rod': length \[m\] is 0"):
        scene.compile()


def circle(arc):
    return jnp.stack([jnp.cos(arc), jnp.sin(arc), 0.0 * arc])


@pytest.mark.parametrize(
    ("curve", "length", "elements", "part"),
    [
        (circle, 2 * np.pi, 1, "element 0"),
        (circle, 2 * np.pi, 2, "turns back"),
        ([(0, 0, 0), (1, 0, 0), (0, 0, 0)], None, 4, "turns back"),
    ],
)
def test_beams_that_turn_too_far_between_nodes_are_refused(curve, length, elements, part):
    section = nc.CircularSection(radius=0.01, E=1e7, density=1000.0)
    with pytest.raises(ValueError, match=f"beam 'ring'.*{part}"):
        nc.Scene().add(nc.Beam(section, curve, length=length, elements=elements, name="ring"))


def test_half_a_turn_of_an_element_has_no_strain():
    """It is not a number, where it was none before: silently."""
    ends = [nc.Attachment(nc.ground, (0, 0, z), np.eye(3)) for z in (0.0, 1.0)]
    element = nc.BeamElement(ends, length=1.0, stiffness=np.eye(6))
    place = jnp.array([0.0, 0.0, 1.0])
    assert np.all(np.isnan(element.strains(jnp.concatenate([jnp.zeros(3), -jnp.ones(1), place]))[3:]))
    nearly = jnp.array([2 * np.sin(3.1), 0.0, 0.0, 1 + 2 * np.cos(3.1), *place])
    assert float(element.strains(nearly)[3]) == pytest.approx(3.1, rel=tol.INDIFFERENCE)


@pytest.mark.parametrize("n", [1, 2, 10])
def test_lumped_inertia_of_a_beam_is_what_its_docstring_says(n):
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=1.0, GJ=1.0, density=3.0, rotary=0.0)
    for point, factor in ((0.0, (1 + 1 / (2 * n**2)) / 3), (-0.5, (1 + 2 / n**2) / 12)):
        scene = nc.Scene()
        beam = scene.add(nc.Beam(section, [(2 * point, 0, 0), (2 * point + 2, 0, 0)], elements=n))
        masses = [scene.bodies[h.name].mass_block[0, 0] for h in beam.nodes]
        places = [scene.bodies[h.name].position[0] for h in beam.nodes]
        inertia = sum(m * x**2 for m, x in zip(masses, places, strict=True))
        assert float(inertia) == pytest.approx(6.0 * 4.0 * factor, rel=tol.INDIFFERENCE)


def test_a_rotor_that_turns_too_far_in_a_step_is_told():
    """At 2.5 rad a step the rate shows 250 rad/s beside an angle that says 179; with the step that is advised
    both are the same to a percent, and nothing is said."""
    scene = nc.Scene()
    rotor = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    hinge = scene.add(nc.Revolute(nc.ground, rotor, name="hinge"))
    system, state = scene.compile()
    spinning = system.with_coordinate(state, hinge, 0.0, rate=250.0)
    with pytest.warns(UserWarning, match=r"'hinge' turns by 1\.79 rad in a step of 0\.01 s.*dt = 0\.0014 s"):
        nc.simulate(system, spinning, dt=0.01, steps=4)
    with pytest.warns(UserWarning, match=r"'hinge' turns by 1\.79 rad"):
        nc.simulate(system, spinning, dt=0.01, steps=4, save_every=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = nc.simulate(system, spinning, dt=0.0014, steps=4)
        jax.jit(lambda s: nc.simulate(system, s, dt=0.01, steps=4).q)(spinning)
    assert float(run.states.coordinates[-1, 0] / run.t[-1]) == pytest.approx(250.0, rel=0.0105)


# --- derivatives that are none ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turntable():
    """A disc on a hinge with a motor."""
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0)))
    hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def unsolvable(monkeypatch):
    """Linear systems of derivatives are found unsolved from now on."""
    judged = LinearIteration.judged

    def never(self, *args, **kwargs):
        found, factors = judged(self, *args, **kwargs)
        no, yes = jnp.zeros_like(found.done), jnp.ones_like(found.done)
        given = no, yes, jnp.zeros_like(found.rounds) + ROUNDS
        return eqx.tree_at(lambda c: (c.done, c.wanting, c.rounds), found, given), factors

    monkeypatch.setattr(LinearIteration, "judged", never)


MODES = {
    "grad": lambda f, x: jax.grad(f)(x),
    "jvp": lambda f, x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1],
    "jacrev": lambda f, x: jax.jacrev(f)(x),
    "jacfwd": lambda f, x: jax.jacfwd(f)(x),
    "hessian": lambda f, x: jax.hessian(f)(x),
}


@pytest.mark.parametrize(
    "mode",
    ["grad", "jvp", *(pytest.param(m, marks=pytest.mark.slow) for m in ("jacrev", "jacfwd", "hessian"))],
)
def test_a_derivative_that_is_none_is_an_error_in_python_and_nan_in_jit(turntable, mode):
    system, state = turntable

    def end(u, law):
        given = dict(dt=0.1, steps=5, inputs=lambda t, s: u * law(s.coordinates[:1]))
        return nc.simulate(system, state, **given).states.coordinates[-1, 0]

    rough, u = partial(end, law=lambda x: jnp.sqrt(jnp.abs(x))), jnp.array([0.5])
    with pytest.raises(nc.DerivativeError, match="simulate: a derivative is not a number"):
        MODES[mode](rough, u)
    assert np.all(np.isnan(nc.jit(partial(MODES[mode], rough))(u)))
    assert np.all(np.isfinite(MODES[mode](partial(end, law=jnp.cos), u)))


def test_what_is_no_number_before_is_no_fault_of_a_run(turntable):
    system, state = turntable

    def end(u):
        return nc.simulate(system, state, dt=0.1, steps=5, inputs=jnp.sqrt(u)).states.coordinates[-1, 0]

    assert np.isinf(jax.grad(end)(jnp.zeros(1))[0])
    assert np.isnan(jax.grad(lambda u: jnp.sqrt(end(u)) * 0.0)(jnp.zeros(1))[0])


@pytest.mark.parametrize("mode", ["grad", "jvp"])
def test_a_system_that_corrections_do_not_solve_is_reported(turntable, mode, monkeypatch):
    system, state = turntable
    unsolvable(monkeypatch)

    def end(u):  # (a number of steps of its own: another program)
        inputs = jnp.broadcast_to(u, (67, 1))
        return nc.simulate(system, state, dt=0.1, inputs=inputs, save_every=67).states.coordinates[-1, 0]

    with pytest.raises(nc.DerivativeError):
        MODES[mode](end, jnp.ones(1))


@pytest.mark.slow
def test_control_says_that_a_step_has_no_derivative(turntable, monkeypatch):
    system, state = turntable
    problem = nc.OptimalControl(
        system, state, dt=0.1, steps=7, cost=nc.cost.Effort(), goal=nc.goal.Coordinate("hinge", 1.0)
    )
    monkeypatch.setattr(costates, "UNSOLVED", -1.0)
    for method in ("shooting", "lifted", "auto"):
        solution = nc.optimise(problem, method=method, progress=False)
        assert solution.outcome is nc.Outcome.SINGULAR
        assert "linearised equations have no solution" in solution.explain()


def test_descent_ends_where_there_is_no_slope(turntable):
    system, state = turntable
    rough = nc.cost.Terminal(lambda state: jnp.sqrt(jnp.abs(state.coordinates[0])))
    problem = nc.OptimalControl(system, state, dt=0.1, steps=5, cost=rough)
    solution = nc.descend(problem, iterations=3, progress=False)
    assert solution.outcome is nc.Outcome.NONFINITE
    assert np.all(np.isfinite(solution.inputs))


@pytest.mark.slow
def test_known_tangents_and_unknown_ones_pass_side_by_side(turntable):
    """The gradient of a directional derivative along a direction that is fixed, several of them at once."""
    system, state = turntable

    def end(u, dt):
        return nc.simulate(system, state, dt=dt, inputs=u).states.coordinates[-1, 0]

    def along(u, direction):
        return jax.jvp(partial(end, u), (0.1,), (direction,))[1]

    u, directions = jnp.ones((5, 1)), jnp.array([1.0, 2.0])
    every = jax.vmap(jax.grad(along), (None, 0))(u, directions)
    slope = jax.grad(lambda u: jax.grad(end, 1)(u, 0.1))(u)
    np.testing.assert_allclose(every, directions[:, None, None] * slope, rtol=tol.SAME_GRADIENT)
