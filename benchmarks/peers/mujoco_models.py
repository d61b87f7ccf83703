"""The benchmark models in MuJoCo, native code (written for MuJoCo 3 and 4).

Loops are closed by equality constraints between bodies of a spanning tree: a common point or, where a hinge
has to hold directions, two on its axis. They are soft, and as stiff here as the documentation advises: the
least time constant, two steps, damping ratio one, the highest impedance. As the time constant goes with the
step, errors vanish with it, at order two at best. Shorter ones, which the direct form (negative solref)
allows, make implicitfast diverge from 1.2 steps down and the error of RK4 on Bricard's mechanism grow.

usage: python -m benchmarks.peers.mujoco_models MODEL STEPS [integrator=Euler|implicitfast|implicit|RK4]
       [t_end=10 records=1000]
"""

import mujoco
import numpy as np

from benchmarks.peers.measure import (
    MODELS,
    command_line,
    energies,
    final_state,
    loops,
    moving,
    per_step,
    seconds,
    times_per_call,
    turning,
)

TIME_CONSTANT = 2.0
"""Of constraints, in time steps: the least that MuJoCo takes."""
IMPEDANCE = 0.9999
"""Of constraints: the most that MuJoCo takes."""

_SOFT = {"time_constant_in_steps": TIME_CONSTANT, "impedance": IMPEDANCE}

# Divergence shows in the final state; MuJoCo would write it to a file in the working directory.
mujoco.set_mju_user_warning(lambda message: None)

# The joints of MuJoCo that make up one joint of the data, and which of its axes each one uses.
_JOINTS = {
    "free": [("free", None)],
    "revolute": [("hinge", 0)],
    "spherical": [("ball", None)],
    "prismatic": [("slide", 0)],
    "universal": [("hinge", 0), ("hinge", 1)],
    "cylindrical": [("slide", 0), ("hinge", 0)],
}


def _text(vector) -> str:
    """A vector as an MJCF attribute, in full precision."""
    return " ".join(repr(float(x)) for x in vector)


def _sites(model, body) -> str:
    """End points of the point springs on a body (None: the ground)."""
    com = (0.0, 0.0, 0.0) if body is None else model.BODIES[body]["com"]
    return "".join(
        f'<site name="{k}{end}" pos="{_text(np.subtract(spring["point_" + end], com))}"/>'
        for k, spring in enumerate(model.POINT_SPRINGS)
        for end in "ab"
        if spring["body_" + end] == body
    )


def _joints(body: dict, number: int) -> str:
    """The MJCF joints of one body, through its joint point."""
    text = ""
    for kind, which in _JOINTS[body["joint"]]:
        if kind == "free":
            return f'<freejoint name="{number}"/>'
        axis = "" if which is None else f'axis="{_text(body["axes"][which])}"'
        name = f'name="{number}"' if body["joint"] == "revolute" else ""
        text += (
            f'<joint {name} type="{kind}" pos="{_text(np.subtract(body["point"], body["com"]))}" {axis} '
            f'stiffness="{body["stiffness"]}" damping="{body["damping"]}"/>'
        )
    return text


def _bodies(model, parent) -> str:
    """The bodies that hang on `parent`, with their children; frames at the centres of mass, in world axes."""
    origin = (0.0, 0.0, 0.0) if parent is None else model.BODIES[parent]["com"]
    text = ""
    for i, body in enumerate(model.BODIES):
        if body["parent"] == parent:
            place = _text(np.subtract(body["com"], origin))
            text += (
                f'<body name="{body["name"]}" pos="{place}">{_joints(body, i)}'
                f'<inertial pos="0 0 0" mass="{body["mass"]}" diaginertia="{_text(body["inertia"])}"/>'
                f"{_sites(model, i)}{_bodies(model, i)}</body>"
            )
    return text


def _closures(model, timestep: float) -> str:
    """The joints that close loops: a point in common, and one more on the axis where it needs holding."""
    solref = _text((TIME_CONSTANT * timestep, 1.0))
    text = ""
    for loop in loops(model):
        body, other = loop["body_b"], loop["body_a"]
        names = f'body1="{model.BODIES[body]["name"]}"'
        names += "" if other is None else f' body2="{model.BODIES[other]["name"]}"'
        anchors = [np.subtract(loop["point"], model.BODIES[body]["com"])]
        if any(loop["independent"][3:]):
            anchors.append(anchors[0] + loop["axes"][0])
        for anchor in anchors:
            place = f'anchor="{_text(anchor)}" solref="{solref}" solimp="{IMPEDANCE} {IMPEDANCE} 1"'
            text += f"<connect {names} {place}/>"
    return text


def mjcf(model, timestep: float, integrator: str) -> str:
    """The model as MJCF text; contacts, and constraints where it has none, are switched off.

    Args:
        model: a module of data, `open_tree` or `spacecraft`.
        timestep: [s].
        integrator: a name known to MuJoCo.
    """
    constraint, closures = "enable" if loops(model) else "disable", _closures(model, timestep)
    tendons = "".join(
        f'<spatial stiffness="{s["stiffness"]}" damping="{s["damping"]}" springlength="{s["length"]}">'
        f'<site site="{k}a"/><site site="{k}b"/></spatial>'
        for k, s in enumerate(model.POINT_SPRINGS)
    )
    motors = "".join(f'<motor joint="{body}"/>' for body, _ in model.MOTORS)
    return (
        f'<mujoco><option gravity="{_text(model.GRAVITY)}" timestep="{timestep!r}" integrator="{integrator}">'
        f'<flag contact="disable" constraint="{constraint}" autoreset="disable"/></option>'
        f"<worldbody>{_sites(model, None)}{_bodies(model, None)}</worldbody>"
        f"<tendon>{tendons}</tendon><equality>{closures}</equality><actuator>{motors}</actuator></mujoco>"
    )


def build(model, timestep: float, integrator: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data at t = 0, motors on; arguments as in `mjcf`."""
    mj_model = mujoco.MjModel.from_xml_string(mjcf(model, timestep, integrator))
    data = mujoco.MjData(mj_model)
    data.ctrl[:] = [torque for _, torque in model.MOTORS]
    for body in model.BODIES:
        first = mj_model.body(body["name"]).dofadr[0]
        spin = turning(body) - (0.0 if body["parent"] is None else turning(model.BODIES[body["parent"]]))
        if body["joint"] == "free":
            data.qvel[first : first + 6] = *moving(body), *spin
        elif body["joint"] == "spherical":
            data.qvel[first : first + 3] = spin
        elif body["joint"] == "revolute":
            data.qvel[first] = np.dot(body["axes"][0], spin)
    return mj_model, data


def read_state(model, mj_model: mujoco.MjModel, data: mujoco.MjData) -> dict:
    """`final_state` of the configuration and velocity in `data`."""
    mujoco.mj_forward(mj_model, data)
    count = len(model.BODIES)
    velocity = np.zeros((count, 6))  # angular, linear
    for i, body in enumerate(model.BODIES):
        mujoco.mj_objectVelocity(
            mj_model, data, mujoco.mjtObj.mjOBJ_BODY, mj_model.body(body["name"]).id, velocity[i], 0
        )
    order = [mj_model.body(body["name"]).id for body in model.BODIES]
    rotation = data.xmat.reshape(-1, 3, 3)[order]
    return final_state(model, data.xipos[order], rotation, velocity[:, 3:], velocity[:, :3])


def run(
    model: str,
    steps: int,
    *,
    integrator: str = "Euler",
    t_end: float | None = None,
    records: int = 0,
    repeats: int = 7,
) -> dict:
    """Times `steps` steps over [0, t_end] and returns times and final state.

    Args:
        model: a name in `MODELS`.
        steps: number of steps.
        integrator: Euler (semi-implicit, the default of MuJoCo), implicitfast, implicit or RK4.
        t_end: [s]; None: `T_END` of the model.
        records: number of equal parts of the run, of steps / records steps each, at whose ends `energies` are
            recorded (in "records", with those of the start); the run is then made once. 0: none.
        repeats: timed repetitions.
    """
    source = MODELS[model]
    end = source.T_END if t_end is None else t_end
    mj_model, data = build(source, end / steps, integrator)
    start, velocity = data.qpos.copy(), data.qvel.copy()

    def rollout():
        data.qpos[:], data.qvel[:], data.time = start, velocity, 0.0
        data.qacc_warmstart[:] = 0.0
        mujoco.mj_step(mj_model, data, nstep=steps)

    found = {}
    if records:
        kept = [energies(read_state(source, mj_model, data))]

        def recorded():
            for _ in range(records):
                mujoco.mj_step(mj_model, data, nstep=steps // records)
                kept.append(energies(read_state(source, mj_model, data)))

        timing = per_step([seconds(recorded)], steps)
        found = {"records": kept}
    else:
        timing = per_step(times_per_call(rollout, repeats), steps)
    return {
        "peer": "mujoco",
        "version": mujoco.__version__,
        "model": model,
        "steps": steps,
        "h": end / steps,
        "settings": {"integrator": integrator} | (_SOFT if loops(source) else {}),
        **timing,
        **read_state(source, mj_model, data),
        **found,
    }


if __name__ == "__main__":
    command_line(run)
