"""Conservation and order: joint by form by scheme, and what the energy of each scheme does.

Each scene is made to move energy between all its stores and to turn; a scene at rest conserves anything.
Step sizes, gravity and suspension are numbers: one program serves all runs of a scene.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account, rows
from differences import alternation
from law_cases import DISSIPATIVE, FORMS, MOST, ORDERS, SCHEMES, VARIATIONAL, compiled, in_order, lane, run
from scenes import AXIS, JOINTS, SECOND

import natcoord_jax as nc
from natcoord_jax import gallery

DT = 0.02
EXCHANGED = 0.2
BODIES = ("first", "second")

DEFAULT = {
    ("universal", "tree", "order 2"),
    ("universal", "multipliers", "order 2"),
    ("revolute", "tree", "order 6"),
    ("revolute", "tree", "variational"),
}
SLOW = {
    ("screw", "tree", "order 2"),
    ("spherical", "multipliers", "dissipative"),
}
# Every joint in either form at order two; elsewhere each meets each scheme in one form.
ONE_FORM = {"order 4": 0, "order 6": 1, "variational": 0, "dissipative": 1}
CASES = [
    *((joint, form, "order 2") for joint in JOINTS for form in FORMS),
    *((joint, FORMS[(k + n) % 2], name) for name, n in ONE_FORM.items() for k, joint in enumerate(JOINTS)),
    *(("universal", "tree", name) for name in ("order 2 with kicks", "order 8", "order 10")),
]
CASES += sorted((DEFAULT | SLOW) - set(CASES))
NAMES = ("joint", "form", "scheme")
KEEP_ENERGY = [case for case in CASES if isinstance(SCHEMES[case[2]], nc.EnergyMomentum)]
ORDER_TWO = [case for case in CASES if case[2] == "order 2"]


def table(cases):
    return pytest.mark.parametrize(NAMES, [lane(case, DEFAULT, SLOW) for case in cases])


@cache
def moved(joint, form, scheme, free, dt, steps=MOST):
    system, state = compiled(joint, form, free)
    return system, run(system, state, dt, steps, SCHEMES[scheme])


def step_and_number(scheme):
    """Of the usual runs: a thousand steps at order two, fewer and longer ones above."""
    return (2 * DT, 300) if scheme in {f"order {k}" for k in ORDERS[1:]} else (DT, MOST)


@table(KEEP_ENERGY)
def test_energy_and_spin_of_a_hung_pair(joint, form, scheme):
    """Hung by a spring under gravity: energy, and the angular momentum about the vertical."""
    system, trajectory = moved(joint, form, scheme, False, *step_and_number(scheme))
    result = account(system, trajectory)
    still = {"between"} if joint == "fixed" else set()
    idle = {
        name: share
        for name, share in result.exchanged().items()
        if share < EXCHANGED and name not in still and not name.startswith("coil")
    }
    assert not idle, "these stores exchange too little energy for the test to mean anything"
    assert result.turned >= 1.0
    assert result.energy_error <= tol.ENERGY
    assert result.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert max(result.directors, result.joints) <= tol.CONSTRAINT
    if SCHEMES[scheme].kick is not None or SCHEMES[scheme].order > 2:
        errors = system.constraint_errors(trajectory)
        assert max(float(jnp.max(x)) for x in jax.tree.leaves(errors)) <= tol.TANGENT


@table(CASES)
def test_momenta_of_a_free_pair(joint, form, scheme):
    """Free in space with springs inside: a tenth of a radian a step, and more where energy decays.

    (Like every symplectic method the variational one leaves a motion that steps do not resolve: then its
    energy has no bound, and steps fail. Bodies that only a distance holds swing round each other fastest.)
    """
    which, (dt, steps) = SCHEMES[scheme], step_and_number(scheme)
    if which is VARIATIONAL:
        dt, steps = (0.02 if joint == "distance" else 0.05), 300
    elif which is DISSIPATIVE:
        dt, steps = 0.1, 300
    system, trajectory = moved(joint, form, scheme, True, dt, steps)
    result = account(system, trajectory)
    assert joint == "fixed" or result.exchanged()["between"] >= EXCHANGED
    assert result.turned >= 1.0
    assert result.momentum_error() <= tol.MOMENTUM
    assert result.spin_error() <= tol.ANGULAR_MOMENTUM
    assert max(result.directors, result.joints) <= tol.CONSTRAINT
    if which is VARIATIONAL:
        assert float(jnp.max(system.constraint_errors(trajectory).velocity)) <= tol.TANGENT
    else:
        # With what was dissipated among the works, the balance closes to round-off.
        assert result.energy_error <= tol.ENERGY
    if which is DISSIPATIVE:
        energy = np.asarray(system.energy(trajectory).total)
        assert np.max(np.diff(energy)) <= tol.STEP_BALANCE * result.energy_scale


@table(ORDER_TWO)
def test_big_steps(joint, form, scheme):
    """Half a radian and more per step: conservation is no matter of accuracy."""
    for dt in (0.1, 0.2):
        result = account(*moved(joint, form, scheme, False, dt))
        assert result.energy_error <= tol.ENERGY, dt
        assert result.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM, dt
        assert max(result.directors, result.joints) <= tol.CONSTRAINT, dt


@pytest.mark.parametrize("joint", [lane((joint,), {("universal",)}, set()) for joint in JOINTS])
def test_forms_give_one_trajectory(joint):
    """What is solved for does not change the motion."""
    early = []
    for form in FORMS:
        system, trajectory = moved(joint, form, "order 2", False, DT)
        early.append(in_order(system, trajectory.q[:100], BODIES))
    assert np.max(np.abs(early[0] - early[1])) <= tol.SAME_TRAJECTORY


@pytest.mark.parametrize(
    ("joint", "form"),
    [lane((joint, form), set(), {("screw", "tree")}) for joint in JOINTS for form in FORMS],
)
def test_what_is_read_does_not_alternate(joint, form):
    """And obeys the constraints, though the velocities that the step carries on do neither."""
    system, trajectory = moved(joint, form, "order 2", False, DT / 4)
    sensed = [system.sense(trajectory, name) for name in BODIES]
    read = [sensed[0].angular_velocity, sensed[1].angular_velocity, system.sense(trajectory, "joint").rates]
    assert alternation(np.concatenate([np.asarray(x) for x in read], axis=1)) <= tol.ALTERNATION
    assert alternation(np.concatenate([np.asarray(x.velocity) for x in sensed], axis=1)) <= tol.ALTERNATION
    assert np.max(system.constraint_errors(trajectory).velocity) <= tol.TANGENT
    assert np.max(system.constraint_errors(trajectory.states).velocity) > tol.TANGENT


def turning(axis, angle):
    """Matrix of a rotation."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.mark.parametrize("joint", [lane((joint,), {("universal",)}, {("screw",)}) for joint in JOINTS])
def test_coordinates_are_those_of_the_places(joint):
    """Angles and distances are summed up over the steps; at the end the bodies must be there."""
    system, trajectory = moved(joint, "tree", "order 2", False, DT)
    result = np.asarray(system.sense(trajectory, "joint").coordinates)[-1]
    first, second = np.moveaxis(in_order(system, trajectory.q, BODIES), 1, 0)
    axes = [np.swapaxes(body[[0, -1], 1:], 1, 2) for body in (first, second)]  # directors as columns
    between = [a.T @ b for a, b in zip(*axes)]
    along, across = axes[0][0].T @ AXIS / 3.0, axes[0][0].T @ SECOND / 3.0
    at = [np.array([0.0, 0.1, -1.2] if joint == "distance" else [0.2, 0.1, -1.3]), np.array([0.2, 0.1, -1.3])]
    arms = [a[0].T @ (x - body[0, 0]) for a, x, body in zip(axes, at, (first, second))]
    ends = [body[-1, 0] + a[1] @ arm for body, a, arm in zip((first, second), axes, arms)]
    gap = axes[0][1].T @ (ends[1] - ends[0])
    angle = {"revolute": 0, "cylindrical": 0, "screw": 0, "universal": 0, "planar": 2}.get(joint)
    turned = np.eye(3) if angle is None else turning(along, result[angle])
    if joint == "universal":
        turned = turned @ turning(across, result[1])
    if joint not in ("spherical", "distance"):
        assert np.max(np.abs(between[1] - turned @ between[0])) <= 10 * tol.CONSTRAINT
    slides = {"prismatic": 0, "cylindrical": 1, "screw": 1}.get(joint)
    if slides is not None:
        assert abs(gap @ along - result[slides]) <= 10 * tol.CONSTRAINT
    if joint in ("planar", "distance"):
        length = np.linalg.norm(result[:2] if joint == "planar" else result)
        assert abs(np.linalg.norm(gap) - length) <= 10 * tol.CONSTRAINT


def test_the_library_keeps_the_same_accounts():
    system, trajectory = moved("universal", "tree", "order 2", False, DT)
    result = account(system, trajectory)
    energy = system.energy(trajectory)
    assert np.allclose(energy.kinetic, result.kinetic, rtol=1e-12)
    assert np.allclose(energy.total, result.kinetic + sum(result.stores.values()), rtol=1e-12)
    assert np.allclose(system.momentum(trajectory), result.momenta.sum(1), atol=1e-12)
    assert np.allclose(system.angular_momentum(trajectory), result.spins.sum(1), atol=1e-12)
    height = np.einsum("ka,tka->t", np.asarray(system.mass)[:, 0], rows(trajectory.q)[..., 2])
    assert np.allclose(energy.stores["gravity"], 9.81 * height, rtol=1e-12)


# --- order ------------------------------------------------------------------------------------------------

END = 1.0  # [s]
COARSE = {"order 4": 40, "order 6": 16, "order 8": 12, "order 10": 8}
"""Steps of the coarsest run: errors of three runs stay above round-off and fall as they should."""
FORM = {"dissipative": "multipliers"}
IN_DEFAULT = {("order 6",), ("variational",)}


def end(scheme, steps):
    """Positions and admissible velocities at the end."""
    form = FORM.get(scheme, "tree")
    system, trajectory = moved("revolute", form, scheme, False, END / steps, steps)
    last = jax.tree.map(lambda x: x[-1], trajectory.states)
    result = last if SCHEMES[scheme].order > 2 else system.tangent(last)
    return np.stack([in_order(system, x, BODIES) for x in (result.q, result.v)])


@pytest.mark.parametrize("scheme", [lane((name,), IN_DEFAULT, set()) for name in SCHEMES])
def test_order_of_positions_and_velocities(scheme):
    """By differences of three runs; their limit is that of order six."""
    count, order = COARSE.get(scheme, 160), SCHEMES[scheme].order
    coarse, middle, fine = (end(scheme, n * count) for n in (1, 2, 4))
    wanted = end("order 6", 100)
    allowed = tol.ORDER_TOLERANCE if order == 2 else tol.HIGH_ORDER_TOLERANCE * order
    for k, x in enumerate(("positions", "velocities")):
        steps = [np.max(np.abs(b[k] - a[k])) for a, b in ((coarse, middle), (middle, fine))]
        assert np.log2(steps[0] / steps[1]) == pytest.approx(order, abs=allowed), x
        limit = fine[k] + (fine[k] - middle[k]) / (2**order - 1)
        assert np.max(np.abs(limit - wanted[k])) <= max(0.02 * steps[1], tol.SAME_TRAJECTORY), x


@cache
def craft():
    return gallery.load("spacecraft")


def forced(order: int, steps: int):
    """The paper's spacecraft under torques that change smoothly."""
    example, dt = craft(), 2.0 / steps
    scheme = nc.EnergyMomentum(order=order)
    times = scheme.times(dt, steps)
    inputs = 300.0 * jnp.sin(jnp.stack([3 * times, 2 * times + 1, times - 1], axis=-1))
    return nc.simulate(example.system, example.state, dt=dt, inputs=inputs, scheme=scheme)


@pytest.mark.parametrize("order", [lane((order,), set(), set()) for order in ORDERS])
def test_order_under_torques_given_at_the_stages(order):
    wanted = forced(10, 64)
    steps = {2: 32, 4: 32, 6: 16, 8: 12, 10: 6}[order]
    errors = []
    for count in (steps, 2 * steps):
        result = forced(order, count)
        errors.append([float(jnp.max(jnp.abs(x[-1] - y[-1])))
                       for x, y in ((result.q, wanted.q), (result.v, wanted.v))])  # fmt: skip
    observed = np.log2(np.divide(*errors))
    assert np.all(np.abs(observed - order) <= tol.HIGH_ORDER_TOLERANCE * order), observed


@pytest.mark.exhaustive
def test_compositions_of_the_one_stage_step_go_the_same_way():
    """Order four without stages or kicks: five steps of order two, the middle one back in time.

    Suzuki's coefficients. Back in time is forth with velocities turned round, as the step is symmetric.
    """
    example, t_end = gallery.load("heavy_top"), 0.1
    system, part = example.system, 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
    parts = jnp.array([part, part, 1.0 - 4.0 * part, part, part])

    def turned_round(state, back):
        sign = jnp.where(back, -1.0, 1.0)
        return state.__class__(**(vars(state) | {"v": sign * state.v, "rates": sign * state.rates}))

    def composed(steps):
        def body(state, h):
            after = nc.step(system, turned_round(state, h < 0), None, jnp.abs(h))
            return turned_round(after, h < 0), None

        lengths = jnp.tile(parts, steps) * t_end / steps
        return jax.jit(lambda s: jax.lax.scan(body, s, lengths)[0])(example.state)

    wanted = nc.simulate(system, example.state, dt=t_end / 40, steps=40, scheme=nc.EnergyMomentum(order=8))
    coarse, fine = composed(50), composed(100)
    errors = [float(jnp.max(jnp.abs(x.q - wanted.q[-1]))) for x in (coarse, fine)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)
    assert float(jnp.max(jnp.abs((16 * fine.q - coarse.q) / 15 - wanted.q[-1]))) < 0.05 * errors[1]
    energies = [float(system.energy(x).total) for x in (example.state, fine)]
    assert energies[1] == pytest.approx(energies[0], rel=tol.ENERGY)


# --- one body, loops, long runs ---------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_a_body_that_turns_by_two_radians_a_step():
    """At order six, free."""
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 2.5), angular_velocity=(0.1, 1.0, 0.1), name="body"))
    system, state = scene.compile()
    for turn in (0.5, 1.0, 2.0):
        result = account(system, run(system, state, turn, 200, SCHEMES["order 6"]))
        assert result.energy_error <= tol.ENERGY, turn
        assert result.spin_error() <= tol.ANGULAR_MOMENTUM, turn
        assert result.directors <= tol.CONSTRAINT, turn


LOOPS = [(name, scheme) for name in ("four_bar", "bricard") for scheme in ("variational", "dissipative")]


@pytest.mark.parametrize(("name", "scheme"), [lane(c, set(), set()) for c in LOOPS])
def test_loops_and_redundant_constraints(name, scheme):
    example = gallery.load(name)
    trajectory = nc.simulate(example.system, example.state, dt=0.01, steps=100, scheme=SCHEMES[scheme])
    errors = example.system.constraint_errors(trajectory)
    assert float(jnp.max(errors.position)) <= tol.CONSTRAINT
    result = account(example.system, trajectory)
    if scheme == "variational":
        assert float(jnp.max(errors.velocity)) <= tol.TANGENT
        assert 1e-9 < result.energy_error <= 1e-2
    else:
        assert result.energy_error <= tol.ENERGY


@pytest.mark.exhaustive
def test_energy_of_the_variational_scheme_has_no_trend():
    """Over ten thousand steps it oscillates about one level."""
    example = gallery.load("heavy_top")
    trajectory = nc.simulate(example.system, example.state, dt=0.004, steps=10_000, scheme=VARIATIONAL)
    energy = np.asarray(example.system.energy(trajectory).total)
    error = energy - energy[0]
    ripple = np.ptp(error[:2000])
    assert ripple > 1e-9 * abs(energy[0]), "energy is exact here: nothing is tested"
    assert np.ptp(error) <= 1.2 * ripple
    slope = np.polyfit(np.linspace(0.0, 1.0, len(error)), error, 1)[0]
    assert abs(slope) <= 0.05 * ripple
