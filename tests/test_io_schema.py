"""MJCF, element by element of MuJoCo's own schema: what moves there differently is obeyed here, or noted."""

import dataclasses
import re
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

import natcoord_jax as nc

BASE = """
<mujoco>
  <option><flag/></option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" pos="0 0 -9" contype="0" conaffinity="0"/>
    <body name="arm">
      <joint name="hinge" axis="0 1 0"/>
      <geom name="bar" type="capsule" size="0.05" fromto="0 0 0 0.4 0.1 0" contype="0" conaffinity="0"/>
      <site name="tip" pos="0.4 0 0"/>
      <body name="fore" pos="0.4 0 0">
        <joint name="slide" type="slide" axis="1 0 0"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0.1" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="head" pos="0 1 0">
      <joint name="ball" type="ball"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.2 0 0" contype="0" conaffinity="0"/>
    </body>
    <body name="float" pos="0 2 0">
      <joint name="free" type="free"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.2 0 0" contype="0" conaffinity="0"/>
      <site name="eye"/>
    </body>
    <body name="gear" pos="0 3 0">
      <joint name="wheel" axis="0 1 0"/>
      <geom size="0.1" pos="0.1 0 0" contype="0" conaffinity="0"/>
    </body>
    <body name="pinion" pos="0 4 0">
      <joint name="small" axis="0 1 0"/>
      <geom size="0.1" pos="0.1 0 0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="sum"><joint joint="hinge" coef="1"/><joint joint="slide" coef="-2"/></fixed>
    <spatial name="wire"><site site="tip"/><site site="eye"/></spatial>
  </tendon>
  <equality>
    <joint name="mesh" joint1="wheel" joint2="small" polycoef="0 -2 0 0 0"/>
  </equality>
  <actuator>
    <general name="motor" joint="hinge" group="1" gear="3" ctrlrange="-0.5 0.5" ctrllimited="true"/>
    <general name="pull" tendon="sum"/>
  </actuator>
</mujoco>
"""

TENDON = {
    "stiffness": "3", "damping": "2", "frictionloss": "1", "armature": "0.3", "range": "0 0.1",
    "springlength": {"stiffness": "3", "springlength": "0.4"}, "actuatorfrcrange": "-0.1 0.1",
    "springyield": {"stiffness": "3", "springyield": "0.1"}, "limited": {"limited": "true", "range": "0 0.1"},
    "actuatorfrclimited": {"actuatorfrclimited": "true", "actuatorfrcrange": "-0.1 0.1"},
}  # fmt: skip
JOINT = {
    "armature": "0.3", "damping": "0.4", "frictionloss": "0.2", "stiffness": "3", "range": "0 0.1",
    "springref": {"stiffness": "3", "springref": "0.4"}, "ref": "0.3", "pos": "0.1 0 0.05",
    "springdamper": "0.3 0.5", "springyield": {"stiffness": "3", "springyield": "0.1"}, "axis": "0.3 1 0.2",
    "margin": {"range": "-0.8 0.8", "margin": "0.7"}, "limited": {"limited": "true", "range": "0 0.1"},
    "actuatorfrcrange": "-0.1 0.1",
    "actuatorfrclimited": {"actuatorfrclimited": "true", "actuatorfrcrange": "-0.1 0.1"},
    "actuatorgravcomp": {"actuatorgravcomp": "true", "actuatorfrcrange": "-0.1 0.1"},
}  # fmt: skip
ANY_JOINT = "armature", "damping", "frictionloss", "stiffness"
FLAGS = "actuation clampctrl constraint contact damper equality frictionloss gravity limit spring"
ACTUATOR = {
    "actlimited": {"dyntype": "integrator", "actlimited": "true", "actrange": "-0.1 0.1"},
    "actrange": {"dyntype": "integrator", "actrange": "-0.1 0.1"}, "armature": "0.3", "damping": "0.4",
    "biasprm": {"biastype": "affine", "biasprm": "1 -2 -0.3"},
    "biastype": {"biastype": "affine", "biasprm": "1"},
    "ctrllimited": "false", "ctrlrange": "-0.1 0.1", "dyntype": "filter",
    "dynprm": {"dyntype": "filter", "dynprm": "0.3"}, "forcerange": "-0.1 0.1", "gainprm": "2",
    "forcelimited": {"forcelimited": "true", "forcerange": "-0.1 0.1"}, "gear": "2",
    "gaintype": {"gaintype": "affine", "gainprm": "2 0.3 0.1"}, "delay": {"delay": "0.01", "nsample": "3"},
    "actearly": {"dyntype": "integrator", "actearly": "true"},
}  # fmt: skip
OBEYED_OR_NOTED = {
    "option": {
        "actuatorgroupdisable": "1", "density": "300", "viscosity": "2", "gravity": "1 0 -3",
        "wind": {"density": "300", "wind": "3 0 0"},
    },
    "option/flag": {
        name: {f".//{where}": {key: value}, "option/flag": {name: "disable"}}
        for name, (where, key, value) in {
            **{name: ("actuator/general", "gear", "3") for name in FLAGS.split()},
            "damper": ("joint[@name='hinge']", "damping", "3"),
            "spring": ("joint[@name='hinge']", "stiffness", "3"),
            "limit": ("joint[@name='hinge']", "range", "0 0.1"),
            "frictionloss": ("joint[@name='hinge']", "frictionloss", "3"),
        }.items()
    },
    ".//body[@name='fore']": {"gravcomp": "0.5", "pos": "0.2 0.1 0", "euler": "10 20 30"},
    ".//joint[@name='hinge']": JOINT,
    ".//joint[@name='ball']": {k: JOINT[k] for k in (*ANY_JOINT, "range")},
    ".//joint[@name='free']": {k: JOINT[k] for k in ANY_JOINT},
    ".//geom[@name='bar']": {
        "mass": "3", "density": "300", "size": "0.07", "type": "cylinder",
        "fluidshape": {".//geom[@name='bar']": {"fluidshape": "ellipsoid"}, "option": {"density": "300"}},
    },
    "tendon/fixed": TENDON,
    "tendon/spatial": TENDON,
    "tendon/fixed/joint": {"coef": "3"},
    "equality/joint": {"active": "false", "polycoef": "0.1 -3 0 0 0"},
    "actuator/general": ACTUATOR,
}  # fmt: skip
"""Attributes by element, with a value that changes the motion, or with what it takes besides."""

SOFT = "solref solimp solreflimit solimplimit solreffriction solimpfriction torquescale margin"
NAMES = "name class user group childclass material rgba width joint joint1 joint2 tendon site body"
PLACES = "axisangle euler fromto pos quat xyaxes zaxis"
IRRELEVANT = {
    # How MuJoCo solves, what it measures, and how it looks.
    "option": "apirate ccd_iterations ccd_tolerance cone impratio integrator iterations jacobian "
    "ls_iterations ls_tolerance magnetic noslip_iterations noslip_tolerance o_friction o_margin "
    "o_solimp o_solref sdf_initpoints sdf_iterations sleep_tolerance solver timestep tolerance",
    "option/flag": "autoreset diagexact energy eulerdamp filterparent fwdinv invdiscrete ipc island midphase "
    "multiccd nativeccd override passive refsafe sensor sleep speculative warmstart",
    ".//body[@name='fore']": f"{NAMES} {PLACES} fuse mocap simple sleep",
    # (Constraints are exact here, and limits elastic: that is noted once.)
    ".//joint[@name='hinge']": f"{NAMES} {SOFT} type",
    # (Contacts are not read, which is noted.)
    ".//geom[@name='bar']": f"{NAMES} {SOFT} {PLACES} adhesion castshadow conaffinity condim contype "
    "fitscale fluidcoef friction gap hfield mesh priority shellinertia solmix surfacevel",
    "tendon/fixed": f"{NAMES} {SOFT}",
    "equality/joint": f"{NAMES} {SOFT}",
    # (Several controls, cranks and muscles: what has any is left out by name.)
    "actuator/general": f"{NAMES} actdim cranklength cranksite ffrange inheritrange input interp "
    "jointinparent lengthrange nsample refsite slidersite velrange",
}


def variant(path, attribute, value, flagged=True):
    """The base with one attribute, and what it takes besides; None where this MuJoCo does not know it."""
    root = ElementTree.fromstring(BASE)
    changes = value if isinstance(value, dict) else {attribute: value}
    changes = {where: x for where, x in changes.items() if flagged or where != "option/flag"}
    for where, given in changes.items():
        each = given.items() if isinstance(given, dict) else [(where, given)]
        for key, text in each:
            root.find(where if isinstance(given, dict) else path).set(key, text)
    text = ElementTree.tostring(root, encoding="unicode")
    try:
        return text, mujoco.MjModel.from_xml_string(text)
    except ValueError:
        return None


def acceleration(model):
    """At one state, beyond limits and controls."""
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    moved = np.array(model.qpos0)
    mujoco.mj_integratePos(model, moved, rng.normal(size=model.nv), 0.5)
    data.qpos[:], data.qvel[:] = moved, rng.normal(size=model.nv)
    data.ctrl[:], data.act[:] = 0.9, 0.7
    mujoco.mj_forward(model, data)
    return np.array(data.qacc)


def numbers(thing):
    """All that a description has, but for its notes and the model of MuJoCo."""
    if dataclasses.is_dataclass(thing):
        fields = (f.name for f in dataclasses.fields(thing) if f.name not in ("notes", "model", "surface"))
        return [numbers(getattr(thing, name)) for name in fields]
    if isinstance(thing, dict):
        return [numbers(x) for x in thing.values()]
    if isinstance(thing, list | tuple):
        return [numbers(x) for x in thing]
    return np.asarray(thing).tolist()


ATTRIBUTES = [(path, name, value) for path, given in OBEYED_OR_NOTED.items() for name, value in given.items()]


def test_what_changes_the_motion_is_obeyed_or_noted():
    """Beside the base; of flags beside what they switch off."""
    wrong, count = [], 0
    for path, name, value in ATTRIBUTES:
        made = variant(path, name, value)
        text, model = variant(path, name, value if path == "option/flag" else {}, flagged=False)
        if made is None or np.allclose(acceleration(made[1]), acceleration(model), rtol=1e-9, atol=1e-9):
            continue
        count += 1
        plain, robot = nc.io.load(text), nc.io.load(made[0])
        obeyed = numbers(robot.description) != numbers(plain.description)
        noted = {(n.part, n.reason) for n in robot.notes} - {(n.part, n.reason) for n in plain.notes}
        if not obeyed and not noted:
            wrong.append(f"{path}: {name}")
    assert not wrong, "moves otherwise in MuJoCo, and neither here nor in a note:\n" + "\n".join(wrong)
    assert count > 0.8 * len(ATTRIBUTES), "few of the values change the motion"


def schema():
    """Attributes by element, as MuJoCo prints them."""
    found, path = {}, []
    for line in mujoco.mj_printSchema(False, False).splitlines():
        element = re.match(r"^( *)(\S+) \([!?*R+]\) *(.*)", line)
        if element:
            path = [*path[: len(element[1]) // 3], element[2]]
            found.setdefault("/".join(path), set()).update(element[3].split())
        elif line.strip():
            found["/".join(path)] |= set(line.split())
    return found


PRINTED = {
    "option": "mujoco/option", "option/flag": "mujoco/option/flag",
    ".//body[@name='fore']": "mujoco/(world)body", ".//joint[@name='hinge']": "mujoco/(world)body/joint",
    ".//geom[@name='bar']": "mujoco/(world)body/geom", "tendon/fixed": "mujoco/tendon/fixed",
    "equality/joint": "mujoco/equality/joint", "actuator/general": "mujoco/actuator/general",
}  # fmt: skip


def test_every_attribute_of_the_schema_is_known():
    """A MuJoCo with more of them fails here, until they are obeyed, noted or known to do nothing."""
    printed = schema()
    missing = [
        f"{where}: {sorted(printed[where] - set(OBEYED_OR_NOTED[path]) - set(IRRELEVANT[path].split()))}"
        for path, where in PRINTED.items()
        if printed[where] - set(OBEYED_OR_NOTED[path]) - set(IRRELEVANT[path].split())
    ]
    assert len(printed) > 50 and not missing, "\n".join(missing)


ACTUATORS = {
    "motor": "", "position": 'kp="3" kv="0.2"', "velocity": 'kv="2"', "intvelocity": 'kp="3" actrange="-1 1"',
    "damper": 'kv="2" ctrlrange="0 1"', "cylinder": "", "muscle": "",
    "dcmotor": 'motorconst="0.1" resistance="2"',
    "pid": 'kp="3" ki="1" kd="0.1"', "adhesion": 'ctrlrange="0 1"',
}  # fmt: skip


@pytest.mark.parametrize("kind", ACTUATORS)
def test_every_actuator_is_an_input_or_a_note(kind):
    target = 'body="fore"' if kind == "adhesion" else 'joint="wheel" lengthrange="0 1"'
    text = BASE.replace("</actuator>", f'<{kind} name="new" {target} {ACTUATORS[kind]}/></actuator>')
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError:
        pytest.skip("not of this version of MuJoCo")
    robot = nc.io.load(text)
    assert ("new" in robot.inputs) != (kind in ("muscle", "dcmotor", "pid", "adhesion"))
    assert "new" in robot.inputs or "new" in {note.part for note in robot.notes}


ELEMENTS = {
    "(world)body": {
        "inertial": "read", "joint": "read", "freejoint": "read", "geom": "read", "site": "read",
        "attach": "read", "camera": "nothing", "light": "nothing", "plugin": "", "flexcomp": "1 flexes",
    },
    "tendon": {"fixed": "read", "spatial": "stiffness of new"},
    "equality": {
        "connect": "read", "weld": "read", "joint": "read", "tendon": "read", "flex": "", "flexstrain": "",
    },
    "contact": {"pair": "contact of", "exclude": "nothing"},
    "deformable": {"flex": "1 flexes", "skin": "nothing"},
    "keyframe": {"key": "read"},
    "custom": dict.fromkeys(("numeric", "text", "tuple"), "nothing"),
    "extension": {"plugin": ""},
    "asset": dict.fromkeys(("mesh", "hfield", "skin", "texture", "material", "model"), "read"),
    "actuator": dict.fromkeys((*ACTUATORS, "general", "orientation", "plugin"), "read"),
}  # fmt: skip
"""Elements: read, or of no effect on the motion, or what the note on them begins with (of plugins: none)."""
OTHERS = set("compiler option size statistic visual default sensor (world)body frame replicate".split())
UNREAD = {
    "contact/pair": '<contact><pair geom1="bar" geom2="floor"/></contact>',
    "tendon/spatial": '<tendon><spatial name="new" stiffness="3"><site site="tip"/><site site="eye"/>'
    "</spatial></tendon>",
    "sensor": '<sensor><jointpos joint="hinge"/></sensor>',
    "(world)body/flexcomp": '<worldbody><flexcomp name="cloth" type="grid" count="3 3 1" dim="2" mass="1" '
    'spacing="0.1 0.1 0.1" radius="0.01" pos="0 9 0"/></worldbody>',
}


def test_every_element_of_the_schema_is_known():
    missing = []
    for path in schema():
        _, *place = path.split("/")
        if len(place) == 1 and place[0] not in ELEMENTS and place[0] not in OTHERS:
            missing.append(path)
        if len(place) == 2 and place[0] in ELEMENTS and place[1] not in ELEMENTS[place[0]]:
            missing.append(path)
    assert not missing, missing


@pytest.mark.parametrize("element", UNREAD)
def test_elements_that_are_not_read_are_noted(element):
    robot = nc.io.load(BASE.replace("</mujoco>", f"{UNREAD[element]}</mujoco>"))
    owner, _, name = element.partition("/")
    begins = ELEMENTS[owner][name] if name else "1 sensors"
    assert any(note.part.startswith(begins) for note in robot.notes), [note.part for note in robot.notes]
