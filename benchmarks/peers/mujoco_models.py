"""The benchmark models in MuJoCo, native code (written for MuJoCo 3 and 4).

usage: python -m benchmarks.peers.mujoco_models MODEL STEPS [integrator=Euler|implicitfast|implicit|RK4]
"""

import mujoco
import numpy as np

from benchmarks.peers.measure import MODELS, command_line, final_state, per_step, times_per_call, turning

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


def mjcf(model, timestep: float, integrator: str) -> str:
    """The model as MJCF text; contacts and constraints, which it has none of, are switched off.

    Args:
        model: a module of data, `open_tree` or `spacecraft`.
        timestep: [s].
        integrator: a name known to MuJoCo.
    """
    tendons = "".join(
        f'<spatial stiffness="{s["stiffness"]}" damping="{s["damping"]}" springlength="{s["length"]}">'
        f'<site site="{k}a"/><site site="{k}b"/></spatial>'
        for k, s in enumerate(model.POINT_SPRINGS)
    )
    motors = "".join(f'<motor joint="{body}"/>' for body, _ in model.MOTORS)
    return (
        f'<mujoco><option gravity="{_text(model.GRAVITY)}" timestep="{timestep!r}" integrator="{integrator}">'
        f'<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{_sites(model, None)}{_bodies(model, None)}</worldbody>"
        f"<tendon>{tendons}</tendon><actuator>{motors}</actuator></mujoco>"
    )


def build(model, steps: int, integrator: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data at t = 0, motors on, for `steps` steps up to `model.T_END`."""
    mj_model = mujoco.MjModel.from_xml_string(mjcf(model, model.T_END / steps, integrator))
    data = mujoco.MjData(mj_model)
    data.ctrl[:] = [torque for _, torque in model.MOTORS]
    for body in model.BODIES:
        if body["joint"] in ("spherical", "free"):
            last = mj_model.body(body["name"]).dofadr[0] + (3 if body["joint"] == "spherical" else 6)
            data.qvel[last - 3 : last] = turning(body)
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


def run(model: str, steps: int, *, integrator: str = "Euler", repeats: int = 7) -> dict:
    """Times `steps` steps over [0, T_END] and returns times and final state.

    Args:
        model: a name in `MODELS`.
        steps: number of steps.
        integrator: Euler (semi-implicit, the default of MuJoCo), implicitfast, implicit or RK4.
        repeats: timed repetitions.
    """
    source = MODELS[model]
    mj_model, data = build(source, steps, integrator)
    start, velocity = data.qpos.copy(), data.qvel.copy()

    def rollout():
        data.qpos[:], data.qvel[:], data.time = start, velocity, 0.0
        mujoco.mj_step(mj_model, data, nstep=steps)

    timing = per_step(times_per_call(rollout, repeats), steps)
    return {
        "peer": "mujoco",
        "version": mujoco.__version__,
        "model": model,
        "steps": steps,
        "h": source.T_END / steps,
        "settings": {"integrator": integrator},
        **timing,
        **read_state(source, mj_model, data),
    }


if __name__ == "__main__":
    command_line(run)
