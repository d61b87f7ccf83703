"""The scenes of `benchmarks.guard`, the peer of each, and the cells that a run of ten minutes measures.

A peer's run is the yardstick of all cells of its scene: always the same number of steps, in one lane and
without derivatives, so that its time a step is one number that knows nothing of ours.
"""

from collections.abc import Callable
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import contact, contact_peers
from benchmarks.peers.frozen_loop import frozen_loop
from natcoord_jax import gallery

NUMBERS = (10, 100, 1000, 10_000)
LANES = 64


class Subject(NamedTuple):
    """A scene that is ready to run.

    Attributes:
        system: compiled.
        state: at the start.
        dt: step [s].
        inputs: of so many steps (steps, inputs).
    """

    system: nc.System
    state: nc.State
    dt: float
    inputs: Callable[[int], Any]


class Yardstick(NamedTuple):
    """A run of a peer.

    Attributes:
        name: of code and version, by which ratios are told apart.
        steps: of one call.
        call: makes them.
    """

    name: str
    steps: int
    call: Callable[[], object]


def of_gallery(name: str, dt: float | None = None, **options: Any) -> Subject:
    """A scene of the gallery."""
    example = gallery.load(name, **options)
    step = example.dt if dt is None else dt
    return Subject(example.system, example.state, step, lambda steps: example.inputs(steps, step))


def _without_inputs(compiled: tuple[nc.System, nc.State], dt: float) -> Subject:
    system, state = compiled
    return Subject(system, state, dt, lambda steps: jnp.zeros((steps, len(system.structure.inputs))))


def balls_on_floor() -> Subject:
    """Ten balls that bounce, slide and roll."""
    return _without_inputs(contact.ball(10, restitution=0.6, friction=0.3), 5e-3)


def _cloud(count: int = 100) -> tuple[np.ndarray, np.ndarray]:
    random, edge = np.random.default_rng(1), int(np.ceil(count ** (1 / 3)))
    lattice = np.stack(np.meshgrid(*[np.arange(edge)] * 3), axis=-1).reshape(-1, 3)[:count]
    return 0.23 * lattice + 0.01 * random.normal(size=(count, 3)), random.normal(size=(count, 3))


def cloud_of_balls() -> Subject:
    """A hundred balls that collide in flight, by a search for neighbours."""
    return _without_inputs(contact.cloud(*_cloud(), listed=False), 1e-3)


CORNERS = tuple((x, y, -0.2) for x in (-0.3, 0.3) for y in (-0.2, 0.2))
FOOT, HEIGHT = 0.05, 0.3


def four_feet() -> Subject:
    """The trunk of a robot that drops on four round feet, which rub."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    trunk = nc.RigidBody(
        mass=10.0, inertia=(0.2, 0.4, 0.5), position=(0, 0, HEIGHT), velocity=(0.5, 0.2, 0), name="trunk"
    )
    body = scene.add(trunk)
    floor = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
    for k, corner in enumerate(CORNERS):
        markers = (*floor, nc.Point(body, corner, local=True))
        gap = nc.SphereOnPlane(radius=FOOT)
        scene.add(nc.GapConstraint(markers, gap, restitution=0.0, friction=0.5, name=f"foot {k + 1}"))
    return _without_inputs(scene.compile(), 2e-3)


STIFF = 1e4
RUBBING = (
    {"position": (0.0, 0.05, 0.0), "velocity": (1.0, 0.0, 0.0), "angular_velocity": (0.0, 3.0, 20.0)},
    {"position": (0.201, 0.0, 0.0), "velocity": (-1.0, 0.0, 0.0), "angular_velocity": (5.0, 0.0, 1.0)},
)


def rubbing_balls() -> Subject:
    """Two balls, on a spring so that they meet again and again, that rub."""
    scene = nc.Scene()
    shape = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}
    one, other = (scene.add(nc.RigidBody(**shape, **motion)) for motion in RUBBING)
    centres = nc.Point(one, RUBBING[0]["position"]), nc.Point(other, RUBBING[1]["position"])
    scene.add(nc.Spring(centres, stiffness=200.0, length=0.1, name="band"))
    scene.add(nc.Contact(one, other, stiffness=STIFF, friction=0.4, name="touch"))
    return _without_inputs(scene.compile(), 2e-3)


def _limb(name: str, place: str, joint: str, end: str, size: float, inside: str = "") -> str:
    return (
        f'<body name="{name}" pos="{place}">{joint}'
        f'<geom type="capsule" fromto="0 0 0 {end}" size="{size}"/>{inside}</body>'
    )


def _hinge(axis: str, damping: float = 1.0) -> str:
    return f'<joint type="hinge" axis="{axis}" damping="{damping}" stiffness="5"/>'


def humanoid_mjcf() -> str:
    """A humanoid of fourteen bodies and 27 rates, without contact: it is thrown, its joints are springs."""
    sides = ""
    arms = ""
    for side, y in (("left", 1), ("right", -1)):
        foot = _limb(f"{side} foot", "0 0 -0.4", _hinge("0 1 0"), "0.18 0 -0.03", 0.04)
        shin = _limb(f"{side} shin", "0 0 -0.4", _hinge("0 1 0"), "0 0 -0.36", 0.05, foot)
        hip = '<joint type="ball" damping="1" stiffness="5"/>'
        sides += _limb(f"{side} thigh", f"0 {0.1 * y} -0.05", hip, "0 0 -0.36", 0.06, shin)
        forearm = _limb(f"{side} forearm", f"0 {0.25 * y} 0", _hinge("0 0 1"), f"0 {0.24 * y} 0", 0.035)
        shoulder = '<joint type="ball" damping="1" stiffness="5"/>'
        arms += _limb(f"{side} arm", f"0 {0.2 * y} 0.2", shoulder, f"0 {0.22 * y} 0", 0.04, forearm)
    head = _limb("head", "0 0 0.35", _hinge("0 1 0"), "0 0 0.1", 0.09)
    chest = _limb("chest", "0 0 0.15", _hinge("1 0 0"), "0 0 0.25", 0.1, head + arms)
    waist = _limb("waist", "0 0 0.1", _hinge("0 0 1"), "0 0 0.1", 0.09, chest)
    pelvis = f'<geom type="capsule" fromto="0 -0.08 0 0 0.08 0" size="0.09"/>{waist}{sides}'
    return (
        '<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="RK4">'
        '<flag contact="disable" constraint="disable"/></option><default><geom density="1000"/></default>'
        f'<worldbody><body name="pelvis" pos="0 0 1"><freejoint/>{pelvis}</body></worldbody></mujoco>'
    )


def _rates(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=count)


def humanoid() -> Subject:
    """A humanoid from a file, thrown."""
    scene = nc.Scene()
    robot = nc.io.load(humanoid_mjcf())
    handle = scene.add(robot)
    system, state = scene.compile()
    state = handle.state(system, state, None, _rates(robot.description.rate_count))
    return _without_inputs((system, state), 2e-3)


def by_exudyn(steps: int, t_end: float, name: str = "", bars: int = 0) -> Yardstick:
    """Rigid bodies in Exudyn: a module of data, or a row of four-bars."""
    from benchmarks.peers import exudyn_models, four_bar
    from benchmarks.peers.measure import MODELS

    source: Any = (
        MODELS[name]
        if name
        else SimpleNamespace(
            BODIES=four_bar.bodies_of(bars),
            LOOPS=four_bar.loops_of(bars),
            GRAVITY=four_bar.GRAVITY,
            POINT_SPRINGS=(),
            MOTORS=(),
        )
    )
    return Yardstick(f"Exudyn {version('exudyn')}", steps, exudyn_models.rollout(source, steps, t_end))


def rope_by_exudyn(steps: int = 20) -> Yardstick:
    """The rope of 64 elements in Exudyn."""
    from benchmarks.peers import beam_models

    call, _ = beam_models.exudyn_rollout("rope", 64, steps, 1e-3 * steps)
    return Yardstick(f"Exudyn {version('exudyn')}", steps, call)


def by_mujoco(model: Any, steps: int, velocities: Any = None) -> Yardstick:
    """Steps of a model of MuJoCo from its start."""
    import mujoco

    data = mujoco.MjData(model)

    def call() -> None:
        mujoco.mj_resetData(model, data)
        if velocities is not None:
            data.qvel[:] = velocities
        mujoco.mj_step(model, data, nstep=steps)

    return Yardstick(f"MuJoCo {version('mujoco')}", steps, call)


def _xml(body: str, options: str) -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_string(f"<mujoco>{options}<worldbody>{body}</worldbody></mujoco>")


def chain_by_mujoco() -> Yardstick:
    """The chain of 32 links."""
    text, half = "", 0.25
    for k in reversed(range(32)):
        place = f"{0.5 if k else 0} 0 0"
        axis = "0 0.8 0.6" if k % 2 else "0 0.8 -0.6"
        inertia = " ".join([str(0.25 / 12)] * 3)
        text = (
            f'<body pos="{place}"><joint type="hinge" axis="{axis}"/>'
            f'<inertial pos="{half} 0 0" mass="1" diaginertia="{inertia}"/>{text}</body>'
        )
    flags = '<flag contact="disable" constraint="disable"/>'
    return by_mujoco(_xml(text, f'<option timestep="0.005" integrator="RK4">{flags}</option>'), 200)


def balls_by_mujoco() -> Yardstick:
    """The ten balls on a floor."""
    return by_mujoco(contact_peers.mujoco_model(10, 5e-3, None), 500)


def cloud_by_mujoco() -> Yardstick:
    """The hundred balls that collide."""
    places, velocities = _cloud()
    call, _ = contact_peers.mujoco_cloud(places, velocities, 1e-3, 50, contact.SOFT)
    return Yardstick(f"MuJoCo {version('mujoco')}", 50, call)


def feet_by_mujoco() -> Yardstick:
    """The trunk on four feet."""
    feet = "".join(
        f'<geom type="sphere" size="{FOOT}" pos="{x} {y} {z}" mass="0" friction="0.5"/>'
        for x, y, z in CORNERS
    )
    body = (
        '<geom type="plane" size="10 10 1" friction="0.5"/>'
        f'<body pos="0 0 {HEIGHT}"><freejoint/><inertial pos="0 0 0" mass="10" diaginertia="0.2 0.4 0.5"/>'
        f"{feet}</body>"
    )
    options = '<option timestep="0.002" integrator="implicitfast"/>'
    return by_mujoco(_xml(body, options), 1000, (0.5, 0.2, 0, 0, 0, 0))


def rubbing_by_mujoco() -> Yardstick:
    """The two balls that rub."""
    balls = "".join(
        '<body pos="{} {} {}"><freejoint/><geom type="sphere" size="0.1" mass="1" friction="0.4" '
        'solref="-1e4 0"/><site name="{}"/></body>'.format(*motion["position"], name)
        for motion, name in zip(RUBBING, "ab")
    )
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>'
        f"<worldbody>{balls}</worldbody>"
        '<tendon><spatial stiffness="200" springlength="0.1"><site site="a"/><site site="b"/></spatial>'
        "</tendon></mujoco>"
    )
    rates = [x for motion in RUBBING for x in (*motion["velocity"], *motion["angular_velocity"])]
    return by_mujoco(model, 2000, rates)


def humanoid_by_mujoco() -> Yardstick:
    """The humanoid by RK4."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(humanoid_mjcf())
    return by_mujoco(model, 200, _rates(model.nv))


def by_frozen_loop(steps: int = 10) -> Yardstick:
    """The loop of NumPy."""
    return Yardstick(f"frozen loop, NumPy {np.__version__}", steps, frozen_loop(steps))


class Entry(NamedTuple):
    """A scene and its peer.

    Attributes:
        build: of the scene.
        peer: of its yardstick.
        needs: the package of the peer; without it the frozen loop is the yardstick.
    """

    build: Callable[[], Subject]
    peer: Callable[[], Yardstick] = by_frozen_loop
    needs: str = "numpy"


SCENES = {
    "spacecraft": Entry(
        partial(of_gallery, "spacecraft", 5e-3), partial(by_exudyn, 200, 1.0, "spacecraft"), "exudyn"
    ),
    "heavy top": Entry(
        partial(of_gallery, "heavy_top", 1e-3), partial(by_exudyn, 200, 0.05, "heavy_top"), "exudyn"
    ),
    "open tree": Entry(
        partial(of_gallery, "open_tree", 5e-3), partial(by_exudyn, 100, 0.5, "open_tree"), "exudyn"
    ),
    "four-bars, 2": Entry(
        partial(of_gallery, "four_bar", 5e-3), partial(by_exudyn, 100, 0.5, bars=2), "exudyn"
    ),
    "four-bars, 8": Entry(
        partial(of_gallery, "four_bar", 1e-5, bars=8), partial(by_exudyn, 50, 0.25, bars=8), "exudyn"
    ),
    "chain, 32": Entry(partial(of_gallery, "chain", bodies=32), chain_by_mujoco, "mujoco"),
    "rope, 64": Entry(partial(of_gallery, "rope", elements=64), rope_by_exudyn, "exudyn"),
    "plate, 16 x 16": Entry(partial(of_gallery, "flying_plate", counts=(16, 16))),
    "block": Entry(partial(of_gallery, "tumbling_block", counts=(8, 4, 4))),
    "10 balls": Entry(balls_on_floor, balls_by_mujoco, "mujoco"),
    "100 balls": Entry(cloud_of_balls, cloud_by_mujoco, "mujoco"),
    "four feet": Entry(four_feet, feet_by_mujoco, "mujoco"),
    "rubbing balls": Entry(rubbing_balls, rubbing_by_mujoco, "mujoco"),
    "humanoid": Entry(humanoid, humanoid_by_mujoco, "mujoco"),
}


def yardstick(scene: str) -> Yardstick:
    """The peer of a scene, or the frozen loop where its package is missing."""
    entry = SCENES[scene]
    try:
        version(entry.needs)
    except PackageNotFoundError:
        return by_frozen_loop()
    return entry.peer()


class Cell(NamedTuple):
    """One thing that is measured.

    Attributes:
        scene: a name in `SCENES`.
        kind: "value" or "gradient", which is both.
        lanes: 1 or `LANES`.
        steps: number of steps.
    """

    scene: str
    kind: str
    lanes: int
    steps: int


def cells_of(scene: str, kind: str, lanes: int, *numbers: int) -> tuple[Cell, ...]:
    """Cells of one scene that differ in the number of steps."""
    return tuple(Cell(scene, kind, lanes, steps) for steps in numbers)


DEFAULT = (
    # Programs of small scenes may change with the number of steps: the longest run is among the cells.
    *cells_of("spacecraft", "value", 1, *NUMBERS),
    *cells_of("spacecraft", "gradient", 1, 100, 10_000),
    *cells_of("spacecraft", "value", LANES, 100),
    *cells_of("heavy top", "value", 1, *NUMBERS),
    *cells_of("heavy top", "gradient", 1, 100, 10_000),
    *cells_of("heavy top", "value", LANES, 100, 1000),
    *cells_of("heavy top", "gradient", LANES, 100),
    *cells_of("open tree", "value", 1, *NUMBERS),
    *cells_of("open tree", "gradient", 1, 100),
    *cells_of("four-bars, 2", "value", 1, *NUMBERS),
    *cells_of("four-bars, 2", "gradient", 1, 100),
    *cells_of("four-bars, 8", "value", 1, *NUMBERS[:3]),
    *cells_of("chain, 32", "value", 1, 10, 100, 1000),
    *cells_of("rope, 64", "value", 1, 10, 100),
    *cells_of("plate, 16 x 16", "value", 1, 10),
    *cells_of("block", "value", 1, 10),
    *cells_of("10 balls", "value", 1, 10, 1000),
    *cells_of("100 balls", "value", 1, 10, 100),
    *cells_of("four feet", "value", 1, 100, 10_000),
    *cells_of("rubbing balls", "value", 1, 100, 10_000),
    *cells_of("rubbing balls", "value", LANES, 100),
    *cells_of("humanoid", "value", 1, 100, 1000),
)
"""What a run measures by default: as much as ten minutes of two cores hold, by what each cell can catch."""

ALL = tuple(
    Cell(scene, kind, lanes, steps)
    for scene in SCENES
    for kind in ("value", "gradient")
    for lanes in (1, LANES)
    for steps in NUMBERS
)
"""All there are."""
