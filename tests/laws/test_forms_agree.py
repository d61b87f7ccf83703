"""All forms of the equations give one motion, with one derivative: scene by form by scheme.

Could go wrong: what couples bodies or nodes is missing in the pattern of a Jacobian; multipliers that rows
depend on; masses between nodes, nodes without rotary inertia, bodies without mass, in one form only.
"""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from law_cases import DISSIPATIVE, SCHEMES, VARIATIONAL, in_order
from scenes import pair

import natcoord_jax as nc

# --- scenes -----------------------------------------------------------------------------------------------


def wire_and_rod(solver):
    """A body that slides along a wire, and one that hangs from it by a rod."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    bead = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.2, 0.25), position=(0.3, 0, 0), name="bead"))
    bob = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.15), position=(1.3, 0.2, -0.4), name="bob"))
    wire = nc.Point(nc.ground), nc.Direction(nc.ground, (1, 0.2, 0))
    scene.add(nc.PointOnLine((*wire, nc.Point(bead, (0.3, 0.06, 0))), name="wire"))
    scene.add(nc.Rod((nc.Point(bead, (0.5, 0, 0)), nc.Point(bob, (1.2, 0.2, -0.4))), name="rod"))
    return *scene.compile(solver=solver), ("bead", "bob")


class SoftRod(nc.Rod):
    """A rod whose rate follows its multiplier: a damper, as a constraint."""

    compliance = 0.5

    def respond(self, place, motion, now, lam):
        result = super().respond(place, motion, now, lam)
        return dataclasses.replace(result, rows=result.rows + self.compliance * lam / now.h)


def soft_rod(solver):
    """Rows that depend on multipliers: their derivative is in the Jacobian of each form."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    masses = [
        scene.add(nc.PointMass(mass=2.0, position=(1.0 + k, 0, 0.2 * k), name=f"ball {k}")) for k in range(2)
    ]
    scene.add(SoftRod((nc.Point(nc.ground), nc.Point(masses[0]))))
    scene.add(nc.Rod(tuple(map(nc.Point, masses))))
    return *scene.compile(solver=solver), ("ball 0", "ball 1")


def hinge(solver):
    """Two bodies on a hinge, with springs."""
    return *pair(nc.Revolute, solver=solver), ("first", "second")


def ladder(solver, length=4, rods=1):
    """Two chains of bodies on ball joints, side by side, with rods across that close loops."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -9.81)))
    bodies = [
        [
            scene.add(
                nc.RigidBody(
                    mass=1.0, inertia=(0.02, 0.1, 0.1), position=(k + 0.5, float(j), 0.0), name=f"{j} {k}"
                )
            )
            for k in range(length)
        ]
        for j in range(2)
    ]
    for j, row in enumerate(bodies):
        for k, body in enumerate(row):
            before = row[k - 1] if k else nc.ground
            scene.add(nc.Spherical(before, body, point=(float(k), float(j), 0.0)))
    for k in range(1, length, 2):
        for _ in range(rods):
            near, far = (row[k] for row in bodies)
            scene.add(nc.Distance(near, far, parent_point=(k + 0.7, 0.0, 0.0), point=(k + 0.6, 1.0, 0.0)))
    return *scene.compile(solver=solver), tuple(f"{j} {k}" for j in range(2) for k in range(length))


SECTION = dict(EA=1e4, GA=5e3, EI=2.0, GJ=1.5, density=1.0, rotary=1e-3)


def portal(solver):
    """Three beams, clamped at both feet and pushed sideways at a node within."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    section = nc.Section.of_numbers(**SECTION)
    feet = ((0.0, 0.0), (1.0, 0.2))
    posts = [
        scene.add(nc.Beam(section, [(*foot, 0.0), (*foot, 1.0)], elements=4, start=nc.ground))
        for foot in feet
    ]
    bar = scene.add(nc.Beam(section, [(*foot, 1.0) for foot in feet], elements=4, start=posts[0].end))
    scene.add(nc.Fixed(posts[1].end, bar.end))
    pushed = nc.Point(posts[0].at(0.5), (*feet[0], 0.5))
    scene.add(nc.PointForce((pushed,), force=lambda t: jnp.array([2.0, 6.0, 0.0])))
    return *scene.compile(solver=solver), (bar.end,)


def thread(solver):
    """A cantilever whose section has mass and no rotary inertia: its nodes turn as their torques ask."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=2.0, GJ=1.0, density=1.0)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, start=nc.ground))
    return *scene.compile(solver=solver), (beam.end,)


def heavy_rod(solver):
    """A beam with mass between its nodes that hangs on the ground."""
    scene = nc.Scene()
    section = nc.CircularSection(radius=0.05, E=1e9, density=1000.0)
    line = [(0, 0, 0), (1, 0, 0)]
    beam = scene.add(nc.Beam(section, line, elements=3, mass="consistent", start=nc.ground))
    scene.add(nc.Gravity())
    return *scene.compile(solver=solver), (beam.end,)


LOOSE = ("reduced", "full", "sparse")
TREE = ("reduced", "full", "recursive")
SCENES = {
    "wire and rod": (wire_and_rod, LOOSE, 0.02, 50, tol.ENERGY_OF_A_SMALL_SCENE),
    "soft rod": (soft_rod, LOOSE, 0.01, 50, None),
    "hinge": (hinge, TREE, 0.02, 50, tol.ENERGY),
    "ladder": (ladder, LOOSE[1:], 0.02, 50, tol.ENERGY),
    "portal": (portal, LOOSE[1:], 5e-3, 40, tol.ENERGY),
    "thread": (thread, TREE, 4e-3, 50, tol.ENERGY_OF_A_SOLID),
    "heavy rod": (heavy_rod, LOOSE, 0.01, 20, tol.ENERGY_OF_A_SOLID),
}
"""How to make each, its forms, step, number of steps, and the balance of energy."""


def placed(system, trajectory, watched):
    """What is compared: rows of bodies by name, places of nodes."""
    if isinstance(watched[0], str):
        return in_order(system, trajectory.q, watched)
    return np.stack([np.asarray(system.sense(trajectory, node).position) for node in watched], axis=1)


CASES = [
    *(("wire and rod", name) for name in ("order 2", "order 2 with kicks", "order 4")),
    *((scene, name) for scene in ("wire and rod", "hinge") for name in ("variational", "dissipative")),
    *((name, "order 2") for name in SCENES if name != "wire and rod"),
]


@pytest.mark.filterwarnings("ignore:.*solved densely")
@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "scheme"), CASES)
def test_forms_give_one_trajectory(name, scheme):
    """On the constraints; energy is kept where it is."""
    make, solvers, dt, steps, energy = SCENES[name]
    which, result, counts = SCHEMES[scheme], [], []
    for solver in solvers:
        system, state, watched = make(solver)
        trajectory = nc.simulate(system, state, dt=dt, steps=steps, scheme=which)
        errors = system.constraint_errors(trajectory)
        if name == "wire and rod":
            assert errors.position.max() <= tol.CONSTRAINT_OF_A_SMALL_SCENE
            assert errors.velocity.max() <= tol.TANGENT_OF_A_SMALL_SCENE
        if isinstance(which, nc.EnergyMomentum) and energy is not None:
            assert float(nc.balance(system, trajectory).energy.max()) <= energy
        result.append(placed(system, trajectory, watched))
        counts.append(int(trajectory.iterations))
    assert np.max(np.abs(result[0] - result[0][0])) > 1e-3, "nothing moves: nothing is tested"
    for other, solver in zip(result[1:], solvers[1:]):
        assert np.max(np.abs(other - result[0])) <= tol.SAME_TRAJECTORY, solver
    if name == "soft rod":
        # The rod to the ground gives way: a force over its compliance. Newton's Jacobian knows of it.
        assert np.linalg.norm(result[0][-1, 0, 0]) > 1.01 and max(counts) <= 6 * steps
    if name == "thread":
        assert result[0][-1, 0, 2] < -0.1


@pytest.mark.exhaustive
def test_one_gradient_forward_over_reverse_too():
    """Of a ladder, by a factor of all masses."""

    def outcome(solver):
        system, state, bodies = ladder(solver)

        def loss(scale):
            heavier = system.set(list(bodies), mass=scale * jnp.ones(len(bodies)))
            result = nc.simulate(heavier, state, dt=0.02, steps=8, throw=False)
            return jnp.sum(jnp.sin(scale * result.q[-1]))

        gradient = jax.grad(loss)
        return jax.jit(lambda x: (loss(x), *jax.jvp(gradient, (x,), (1.0,))))(1.3)

    for dense, sparse in zip(outcome("full"), outcome("sparse")):
        assert abs(float(dense) - float(sparse)) <= tol.SAME_GRADIENT * abs(float(dense))


@pytest.mark.slow
def test_the_form_is_chosen_and_reported():
    """Large loops are sparse, unless constraints depend on each other; mass between nodes is not for all."""
    system, *_ = ladder("sparse")
    assert "sparse, " in system.report()
    assert "sparse, " not in ladder("full")[0].report()
    assert ladder(None, length=8)[0].structure.solver == "sparse"
    doubled = ladder(None, length=8, rods=2)[0].structure
    assert doubled.solver == "reduced" and doubled.redundant
    with pytest.raises(ValueError, match="without mass between bodies"):
        heavy_rod("recursive")


@pytest.mark.exhaustive
def test_a_mesh_that_is_solved_densely_warns():
    scene = nc.Scene()
    metal = nc.Elastic(E=1e6, nu=0.3, density=1e3)
    scene.add(nc.Solid(nc.mesh.box((1, 0.25, 0.25), (20, 3, 3)), material=metal))
    system, state = scene.compile()

    def traced(scheme):
        jax.eval_shape(lambda: nc.simulate(system, state, dt=1e-3, steps=1, scheme=scheme, throw=False))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        traced(nc.EnergyMomentum())
    for scheme in (nc.EnergyMomentum(order=4), DISSIPATIVE, VARIATIONAL):
        with pytest.warns(UserWarning, match=r"solves the (1008|2016) unknowns of a step densely"):
            traced(scheme)


@pytest.mark.exhaustive
def test_nodes_without_rotary_inertia_at_order_four():
    """Could go wrong: stages at which massless directors have no velocity of their own."""
    system, state, watched = thread("reduced")
    paths = [
        placed(system, nc.simulate(system, state, dt=4e-3, steps=50, scheme=SCHEMES[name]), watched)
        for name in ("order 2", "order 4")
    ]
    np.testing.assert_allclose(*paths, rtol=0, atol=1e-3)
    assert np.max(np.abs(paths[0] - paths[1])) > 1e-7


# --- bodies without mass ----------------------------------------------------------------------------------

SPIN, DRIFT = np.array((0.3, 0.1, -0.2)), np.array((0.1, 0.0, 0.0))


def cross(place, name="cross", spin=SPIN):
    """A body without mass."""
    body = nc.RigidBody(
        mass=1.0, inertia=(1.0, 1.0, 1.0), position=place, velocity=DRIFT, angular_velocity=spin, name=name
    )
    return eqx.tree_at(lambda b: b.mass_block, body, jnp.zeros((4, 4)))


def gimbal(chain, **options):
    """A base and an arm on two crossing axes, by two hinges or by a universal joint, and a tip."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    centre = np.array((0.0, 0.0, 0.5))
    moving = {"velocity": DRIFT, "angular_velocity": SPIN}
    base = scene.add(nc.RigidBody(mass=2.0, inertia=(0.2, 0.2, 0.3), position=centre, **moving, name="base"))
    link = nc.RigidBody(
        mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.1, 0, 0.3), position=centre, **moving, name="arm"
    )
    arm = scene.add(link)
    place = centre + (0.0, 0.5, 0.0)
    moving["velocity"] = DRIFT + np.cross(SPIN, place - centre)
    link = nc.RigidBody(
        mass=0.5, inertia=(0.01, 0.02, 0.03), com=(0.1, 0, 0.3), position=place, **moving, name="tip"
    )
    tip = scene.add(link)
    if chain:
        between = scene.add(cross(centre))
        scene.add(nc.Revolute(base, between, axis=(1, 0, 0), name="first"))
        scene.add(nc.Revolute(between, arm, axis=(0, 1, 0), name="second"))
    else:
        scene.add(nc.Universal(base, arm, axis=(1, 0, 0), second=(0, 1, 0), name="both"))
    scene.add(nc.Revolute(arm, tip, axis=(0, 0, 1), name="wrist"))
    return scene.compile(**options)


@pytest.mark.exhaustive
@pytest.mark.parametrize("solver, order", [("reduced", 2), ("recursive", 4)])
def test_two_hinges_on_a_body_without_mass_are_a_universal_joint(solver, order):
    result = []
    for chain in (False, True):
        system, state = gimbal(chain, solver=solver)
        run = nc.simulate(system, state, dt=0.02, steps=10, scheme=nc.EnergyMomentum(order=order))
        assert nc.balance(system, run).energy.max() < 1e-13
        moving = run.states.q, run.states.v, system.tangent(run).v, system.instant(state).accelerations
        result.append([in_order(system, x, ("base", "arm", "tip")) for x in moving])
    for one, other in zip(*result):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


def test_bodies_without_mass_are_sensed_where_they_are_and_refused_at_ends():
    system, state = gimbal(True)
    sensed = system.sense(state, "cross")
    np.testing.assert_allclose(sensed.com, (0.0, 0.0, 0.5), atol=1e-15)
    slope = jax.grad(lambda m: system.set("arm", mass=m).energy(state).kinetic)(1.0)
    assert np.isfinite(slope)
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="body"))
    end = scene.add(cross((0.0, 0.0, 0.0), name="end", spin=np.zeros(3)))
    scene.add(nc.Revolute(nc.ground, end, name="hinge"))
    with pytest.raises(ValueError, match="moves no mass"):
        scene.compile()
