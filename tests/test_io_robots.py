"""Robots from URDF and MJCF: beside MuJoCo, whose parser reads them, and part by part."""

import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from pages import Page, still
from robots import HARD, agreement

import natcoord_jax as nc

CLOSE = 1e-9
"""What is asked for; it is 1e-14 where inertias are not of very different sizes."""

RICH = """
<mujoco model="rich">
  <compiler angle="radian"/>
  <option gravity="1 -2 -9"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="trunk" pos="0 0 1" quat="0.9 0.1 -0.2 0.3">
      <freejoint name="root"/>
      <geom name="hull" type="box" size="0.3 0.2 0.1" density="300"/>
      <site name="thruster" pos="0.1 0 0.2" euler="0.3 0.4 0"/>
      <body name="hip" pos="0.3 0.1 0" euler="0.2 0 0.4">
        <joint name="roll" type="hinge" axis="1 0 0" ref="0.3" stiffness="7" springref="0.5" damping="0.2"/>
        <joint name="pitch" type="hinge" axis="0 1 0" pos="0.02 0 0.01" armature="0.03"/>
        <joint name="stretch" type="slide" axis="0.3 0 -1" ref="0.1" stiffness="90" damping="1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0 0 -0.4"/>
        <body name="pad" pos="0 0 -0.5" euler="0 0.5 0"><geom type="sphere" size="0.08" pos="0.1 0 0"/></body>
        <body name="foot" pos="0 0 -0.5" gravcomp="0.4">
          <joint name="ankle" type="ball" pos="0 0 0.03" damping="0.05" stiffness="3"/>
          <geom type="ellipsoid" size="0.1 0.05 0.04" pos="0.03 0 0"/>
        </body>
      </body>
      <body name="arm" pos="-0.3 0 0">
        <joint name="elbow" type="hinge" axis="0 0.6 0.8" ref="-0.2"/>
        <inertial pos="0.1 0 0.05" euler="0.4 0.2 0" mass="0.6" diaginertia="0.01 0.02 0.025"/>
      </body>
    </body>
    <body name="rail" pos="2 0 0">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="turn" type="hinge" axis="0 1 0"/>
      <geom type="cylinder" size="0.1 0.2"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="pair"><joint joint="roll" coef="0.5"/><joint joint="elbow" coef="-1.5"/></fixed>
  </tendon>
  <actuator>
    <motor name="plain" joint="elbow" gear="2"/>
    <motor name="cut" joint="pitch" gear="3" ctrlrange="-0.4 0.4" forcerange="-0.3 0.3"/>
    <position name="servo" joint="stretch" kp="40" kv="3" gear="1.5"/>
    <velocity name="speed" joint="x" kv="2"/>
    <general name="general" joint="turn" gaintype="affine" gainprm="2 0.3 0.1" biastype="affine"
      biasprm="0.2 -3 -0.4"/>
    <position name="drawn" tendon="pair" kp="5"/>
    <motor name="rotor" site="thruster" gear="0 0.5 3 0.1 0 0.2"/>
    <motor name="twist" joint="ankle" gear="0.2 0.5 -0.3"/>
    <motor name="above" jointinparent="ankle" gear="0.1 0.2 0.3"/>
    <general name="slow" joint="z" dyntype="filter" dynprm="0.1" gainprm="2"/>
  </actuator>
  <keyframe>
    <key name="bent" qpos="0 0 2 1 0 0 0 0.1 0.2 0.3 0.9 0.1 0.1 0 -0.4 0.5 0.6 0.7" act="10"
      ctrl="1 2 3 4 5 6 7 8 9 0"/>
  </keyframe>
</mujoco>
"""

INERTIAL = '<inertial><mass value="{}"/><origin xyz="{}" rpy="{}"/><inertia {}/></inertial>'
TENSOR = 'ixx="{}" iyy="{}" izz="{}" ixy="0.001" ixz="0" iyz="0.002"'


def link(name, mass=1.0, xyz="0.1 0 0.05", rpy="0.3 0.2 0.1", moments=(0.02, 0.03, 0.04), more=""):
    """A link of URDF."""
    return (
        f'<link name="{name}">{INERTIAL.format(mass, xyz, rpy, TENSOR.format(*moments))}{more}</link>'
        if mass
        else f'<link name="{name}">{more}</link>'
    )


def joint(name, kind, parent, child, xyz="0.2 0 0.3", axis="0 0.6 0.8", more=""):
    """A joint of URDF."""
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="0.1 0.2 0.3"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="{axis}"/>{more}</joint>'


MESH = '<visual><geometry><mesh filename="package://nowhere/shell.stl"/></geometry></visual>'
BOX = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
LIMIT = '<limit lower="0" upper="1" effort="5" velocity="1"/>'
MACHINE = "".join([
    '<robot name="machine">', link("base", more=BOX), link("tower", more=MESH), link("boom"),
    link("tool", 0.2), link("frame", 0.0), link("finger", 0.1), link("other finger", 0.1),
    link("cross", 0.0), link("cup", 0.3),
    link("odd", 0.5, moments=(0.01, 0.01, 0.05)), link("flag", 0.0),
    joint("swing", "continuous", "base", "tower", more='<dynamics damping="0.3" friction="0.1"/>'),
    joint("lift", "prismatic", "tower", "boom", more='<limit lower="0" upper="1" effort="50" velocity="2"/>'),
    joint("flange", "fixed", "boom", "tool"), joint("tip", "fixed", "tool", "frame"),
    joint("close", "prismatic", "tool", "finger", more=LIMIT),
    joint("follow", "prismatic", "tool", "other finger",
          more=LIMIT + '<mimic joint="close" multiplier="-2"/>'),
    joint("first", "continuous", "boom", "cross", axis="1 0 0"),
    joint("second", "continuous", "cross", "cup", axis="0 1 0"),
    joint("third", "continuous", "cup", "odd"), joint("wave", "continuous", "odd", "flag"), "</robot>",
])  # fmt: skip


ARM = "".join([
    '<robot name="arm">', link("base"), link("upper"), link("lower"),
    joint("shoulder", "continuous", "base", "upper", more='<dynamics damping="0.3"/>'),
    joint("elbow", "prismatic", "upper", "lower", more=LIMIT), "</robot>",
])  # fmt: skip


def machine(**options):
    """The machine of the text above."""
    return nc.io.load(MACHINE, **options)


def reasons(robot):
    """What is noted of each part."""
    return {note.part: note.reason for note in robot.notes}


# --- beside MuJoCo ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, options",
    [
        pytest.param(RICH, {}, id="mjcf"),
        pytest.param(MACHINE, {"floating": True}, id="urdf", marks=pytest.mark.slow),
    ],
)
def test_mass_gravity_and_accelerations_are_mujocos(text, options):
    """At ten random states with velocities, torques and controls, some of them cut off."""
    off = agreement(nc.io.load(text, leave_out=HARD, **options))
    assert off.mass < CLOSE and off.gravity < CLOSE and off.acceleration < CLOSE, off


@pytest.mark.exhaustive
def test_torques_of_inverse_dynamics_are_mujocos():
    """Those of the discrete motion approach MuJoCo's at the middle of a step with the square of the step."""
    robot, scene = nc.io.load(ARM, leave_out=HARD), nc.Scene()
    arm = scene.add(robot)
    system, state = scene.compile()
    model = robot.description.model
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    names = [name for name, _ in system.structure.coordinates]
    places = [robot.joints[name].rate_index for name in names]
    channels = [system.input_index(arm.inputs[name]) for name in names]
    size, steps, errors = np.linspace(5.0, 13.0, len(names)), 20, []
    for dt in (0.02, 0.01):
        path = size * (dt * np.arange(1, steps + 1)[:, None]) ** 5
        torques, _ = nc.inverse_dynamics(system, state, path, dt=dt)
        data, t = mujoco.MjData(model), (steps - 0.5) * dt
        data.qpos[places], data.qvel[places] = size * t**5, 5 * size * t**4
        data.qacc[places] = 20 * size * t**3
        mujoco.mj_inverse(model, data)
        errors.append(np.max(np.abs(np.asarray(torques)[-1, channels] - data.qfrc_inverse[places])))
    assert errors[0] < 5e-3 * np.max(np.abs(data.qfrc_inverse))
    # The fourth derivative of the path, by which the error goes, is half as large at half the time.
    assert 7.0 < errors[0] / errors[1] < 9.0


def test_a_stop_gives_way_as_far_as_mujocos_limit():
    text = """<mujoco><option gravity="0 0 0"/><worldbody><body name="rod">
      <joint name="hinge" range="-1 0.1" limited="true" damping="0.5"/>
      <inertial pos="0 0.3 0" mass="1" diaginertia="0.1 0.1 0.1"/></body></worldbody>
      <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    robot = nc.io.load(text)
    model = robot.description.model
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = 0.0, 50.0
    mujoco.mj_step(model, data, 5000)
    depth = data.qpos[0] - np.deg2rad(0.1)
    limit = robot.joints["hinge"]
    assert limit.range[1] == pytest.approx(np.deg2rad(0.1))
    assert 50.0 / limit.stop == pytest.approx(depth, rel=0.02)


def humanoid():
    """A trunk with arms and legs of three hinges each in shoulders and hips, a waist, a neck: 31 rates."""

    def limb(name, place, length, others=""):
        turns = "".join(
            f'<joint name="{name} {axis}" axis="{axis}" armature="0.01" stiffness="2"/>'
            for axis in ("1 0 0", "0 1 0", "0 0 1")
        )
        return (
            f'<body name="{name}" pos="{place}">{turns}<geom type="capsule" size="0.05" '
            f'fromto="0 0 0 0 0 {-length}"/>{others}</body>'
        )

    def hinge(name, length):
        return (
            f'<body name="{name}" pos="0 0 {-length}"><joint name="{name}" axis="0 1 0" armature="0.01"/>'
            f'<geom type="capsule" size="0.04" fromto="0 0 0 0 0 {-length}"/></body>'
        )

    arms = "".join(limb(f"{s} arm", f"0 {y} 0.5", 0.3, hinge(f"{s} elbow", 0.3)) for s, y in SIDES)
    legs = "".join(limb(f"{s} leg", f"0 {y / 2} -0.1", 0.4, hinge(f"{s} knee", 0.4)) for s, y in SIDES)
    head = '<body name="head" pos="0 0 0.6"><joint type="ball"/><geom size="0.1" pos="0 0 0.1"/></body>'
    chest = limb("chest", "0 0 0.1", -0.4, arms + head)
    trunk = f'<freejoint/><geom type="box" size="0.1 0.15 0.1"/>{chest}{legs}'
    return f'<mujoco><worldbody><body name="trunk">{trunk}</body></worldbody></mujoco>'


SIDES = (("left", 0.25), ("right", -0.25))


@pytest.mark.exhaustive
def test_a_humanoid_flies_freely():
    robot = nc.io.load(humanoid())
    scene = nc.Scene()
    handle = scene.add(robot)
    system, state = scene.compile()
    rates = np.random.default_rng(0).normal(size=robot.description.rate_count)
    state = handle.state(system, state, rates=rates)
    run = nc.simulate(system, state, dt=2e-3, steps=1000)
    kept = nc.balance(system, run)
    assert max(np.max(x) for x in (kept.energy, kept.momentum, kept.angular_momentum)) < 1e-11
    total = system.energy(run).total
    assert np.max(np.abs(total - total[0])) < 1e-11 * np.max(np.abs(system.energy(run).kinetic))


# --- part by part -----------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_links_that_are_fixed_to_each_other_are_one_body():
    robot = machine()
    assert robot.bodies == ("tower", "boom", "finger", "other finger", "cross", "cup", "odd")
    scene = nc.Scene()
    crane = scene.add(robot)
    assert crane.bodies["tool"] == crane.bodies["frame"] == crane.bodies["boom"]
    assert crane.bodies["base"] == nc.ground
    system, _ = scene.compile()
    assert float(system.get("boom", "mass")) == pytest.approx(1.2)
    assert not np.any(system.get("cross", "mass_block"))


def test_frames_are_where_mujoco_has_them():
    robot = nc.io.load(RICH, leave_out=HARD)
    scene = nc.Scene()
    handle = scene.add(robot)
    system, state = scene.compile()
    key = handle.keyframes["bent"]
    assert key.inputs.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    model = robot.description.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = key.positions, np.linspace(-1, 1, model.nv)
    mujoco.mj_forward(model, data)
    moved = handle.state(system, state, key.positions, data.qvel)
    for name, frame in {**handle.frames, **handle.sites}.items():
        wanted = data.site(name).xpos if name in handle.sites else data.body(name).xpos
        np.testing.assert_allclose(system.sense(moved, frame.point).position, wanted, atol=1e-14)
    axis = system.sense(moved, handle.sites["thruster"].axes[2])
    np.testing.assert_allclose(axis.position, data.site("thruster").xmat.reshape(3, 3)[:, 2], atol=1e-14)
    for name, joint in handle.joints.items():
        if robot.joints[name].has_coordinate:
            place = robot.joints[name].position_index
            assert float(system.coordinate(moved, joint)) == pytest.approx(key.positions[place])
    assert float(system.constraint_errors(moved).velocity.max()) < 1e-14
    with pytest.raises(ValueError, match=r"positions \[rad, m\] has shape \(2,\); pass \(18,\)"):
        handle.state(system, state, [0.0, 0.0])
    with pytest.raises(ValueError, match=r"positions \[rad, m\] is not finite"):
        handle.state(system, state, np.full(18, np.nan))


@pytest.mark.exhaustive
def test_what_follows_another_joint_does():
    scene = nc.Scene()
    crane = scene.add(machine(leave_out=("limits", "friction")))
    assert "follow" not in crane.inputs
    system, state = scene.compile()
    run = nc.simulate(system, state, dt=0.01, steps=5)
    close, follow = (system.coordinate(run, crane.joints[name]) for name in ("close", "follow"))
    assert abs(close[-1]) > 1e-5
    np.testing.assert_allclose(follow, -2 * close, atol=1e-14)


LOOP = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="crank"><joint name="a" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.5"/>
      <body name="coupler" pos="0 0 0.5"><joint name="b" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 1 0 0.2"/></body></body>
    <body name="rocker" pos="1 0 0"><joint name="c" axis="0 1 0" ref="0.5"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.7"/></body>
    <body name="load" pos="0 1 0"><freejoint/><geom size="0.1"/></body>
    <body name="gear" pos="0 2 0"><joint name="d" axis="0 1 0"/><geom size="0.1" pos="0.1 0 0"/></body>
  </worldbody>
  <equality>
    <connect name="pin" body1="coupler" body2="rocker" anchor="1 0 0.2"/>
    <weld name="hold" body1="rocker" body2="load"/>
    <joint name="mesh" joint1="d" joint2="c" polycoef="0.1 -2 0 0 0"/>
    <joint name="curved" joint1="d" joint2="c" polycoef="0 1 3 0 0"/>
    <weld name="asleep" body1="gear" body2="load" active="false"/>
  </equality>
</mujoco>
"""


@pytest.mark.slow
def test_equality_constraints_hold_and_are_saved():
    robot = nc.io.load(LOOP)
    notes = reasons(robot)
    assert notes["curved"] == "only linear relations between joints are mapped"
    assert notes["asleep"] == "it is not active in the file"
    scene = nc.Scene()
    handle = scene.add(robot)
    system, state = scene.compile(assemble=True)
    assert system.structure.dofs == 1
    c, d = (float(system.coordinate(state, handle.joints[name])) for name in "cd")
    assert d == pytest.approx(0.1 - 2 * (c - 0.5))
    assert float(system.constraint_errors(state).position.max()) < 1e-12
    saved = nc.io.save_mjcf(system, state)
    model = mujoco.MjModel.from_xml_string(saved.text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    assert model.neq == 2  # the weld is the joint by which the load hangs
    assert np.max(np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY])) < 1e-10
    assert "equality constraints: MuJoCo's are soft" in saved.text


def test_what_is_not_mapped_is_listed_by_name():
    text = """<mujoco><option density="1.2"/><worldbody><geom type="plane" size="1 1 1"/>
      <body name="ball"><joint name="socket" type="ball" armature="1" frictionloss="1"/>
        <geom size="0.1"/><site name="s"/></body>
      <body name="rod" pos="1 0 0"><joint name="hinge" frictionloss="0.1"/><geom size="0.1" pos="0 1 0"/>
        <site name="t"/></body></worldbody>
      <tendon><spatial name="wire" stiffness="3"><site site="s"/><site site="t"/></spatial></tendon>
      <actuator><muscle name="muscle" joint="hinge" lengthrange="0.1 1"/>
        <motor name="winch" tendon="wire"/></actuator>
      <sensor><jointpos joint="hinge"/></sensor></mujoco>"""
    notes = reasons(nc.io.load(text))
    assert set(notes) >= {
        "socket", "muscle", "winch", "stiffness of wire", "fluid", "1 sensors", "friction loss"
    }  # fmt: skip
    said = str(nc.io.load(text))
    assert "the armature of a ball joint, which has no single coordinate" in said
    assert "winch: the tendon wire runs through space" in said
    assert any(note.part.startswith("contact of") for note in nc.io.load(text).notes)


def test_foreign_attributes_are_noted():
    """As Drake writes them, with and without a declaration of the prefix."""
    fast = joint("j", "revolute", "a", "b").replace("<joint", '<joint drake:acceleration="3" drake:x="1"', 1)
    for name in ('name="r"', 'name="r" xmlns:drake="http://drake.mit.edu"'):
        more = "<drake:properties/>" + link("b").replace("</link>", "<contact/></link>")
        robot = nc.io.load(f"<robot {name}>{link('a')}{more}{fast}</robot>")
        assert robot.bodies == ("b",)
        said = {part for part, reason in reasons(robot).items() if "extensions" in reason}
        assert said == {"1 <drake:properties>", "1 <contact>", "1 drake:acceleration", "1 drake:x"}


def test_impossible_inertias_are_balanced_and_listed():
    robot = machine()
    assert "balances" in reasons(robot)["odd"]
    odd = next(one for one in robot.description.links if one.name == "odd")
    np.testing.assert_allclose(np.linalg.eigvalsh(odd.inertia), np.trace(odd.inertia) / 3)
    negative = link("a", moments=(-0.01, 0.02, 0.02)) + link("b") + joint("j", "continuous", "a", "b")
    robot = nc.io.load(f'<robot name="r">{negative}</robot>', floating=True)
    assert "balances" in reasons(robot)["a"]
    assert robot.bodies == ("a", "b")


def test_missing_meshes_and_links_without_mass_are_notes():
    notes = reasons(machine())
    assert notes["package://nowhere/shell.stl"] == "the mesh file is not there; it is not drawn"
    assert notes["wave"].startswith("it moves no mass, and is fixed")
    assert nc.io.load(MACHINE).joints["lift"].velocity == 2.0
    assert nc.io.load(MACHINE).joints["lift"].effort == (-50.0, 50.0)


@pytest.mark.exhaustive
def test_several_robots_in_one_scene():
    robot = nc.io.load(nc.io.PENDULUM)
    scene = nc.Scene()
    first = scene.add(robot, name="first")
    quarter = ((0.0, 0.0, 1.0), np.pi / 2)
    second = scene.add(robot, name="second", position=(1, 2, 3), orientation=quarter)
    with pytest.raises(ValueError, match="'first' is taken"):
        scene.add(robot, name="first")
    system, state = scene.compile()
    assert system.structure.inputs == ("first/motor", "second/motor")
    np.testing.assert_allclose(system.sense(state, second.bodies["rod"]).position, (1, 2, 4))
    for name in ("first", "second"):
        assert float(system.get(f"{name}/rod", "mass")) == pytest.approx(1.0)
    state = second.state(system, first.state(system, state, [0.4]), [0.4], [0.2])
    arm = system.sense(state, second.bodies["rod"]).com - jnp.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(arm, (0.0, -0.5 * np.sin(0.4), -0.5 * np.cos(0.4)), atol=1e-14)
    assert len([e for e in scene.effects.values() if isinstance(e, nc.Gravity)]) == 1


def test_what_is_drawn_is_that_of_the_file(tmp_path):
    text = """<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/>
      <geom type="box" size="0.3 0.2 0.1"/><body name="hip" pos="0.3 0.1 0"><joint axis="1 0 0"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0 0 -0.4"/></body></body></worldbody></mujoco>"""
    robot = nc.io.load(text)
    scene = nc.Scene()
    handle = scene.add(robot)
    system, state = scene.compile()
    page = Page(nc.view(system, still(system, state), file=tmp_path / "a.html"))
    trunk, hip = (page.part(handle.bodies[name].name).place for name in ("trunk", "hip"))
    np.testing.assert_allclose(np.ptp(trunk, axis=0), (0.6, 0.4, 0.2), atol=1e-3)
    assert np.min(hip[:, 2]) < -0.44
    assert len(robot.description.links[0].surface.colours) == 6


def test_a_specification_is_read_and_left_as_it_is():
    spec = mujoco.MjSpec.from_string(nc.io.PENDULUM)
    spec.joint("hinge").damping[0] = 0.5
    robot = nc.io.load(spec, leave_out=("gravity",))
    assert robot.joints["hinge"].damping == 0.5 and not np.any(robot.description.gravity)
    assert spec.compile().opt.gravity[2] != 0


def test_what_cannot_float_or_move_is_noted():
    base = f'<robot name="r">{link("world", 0.0)}{link("a")}{joint("j", "planar", "world", "a")}</robot>'
    robot = nc.io.load(base, floating=True)
    assert reasons(robot)["floating"] == "the root link is called world, and that is the ground"
    assert [joint.kind for joint in robot.joints.values()] == ["slide", "slide", "hinge"]
    assert reasons(nc.io.load('<robot name="r"><link name="a"/></robot>'))["all bodies"].startswith(
        "none can"
    )


def test_a_start_beyond_a_limit_is_noted():
    text = nc.io.PENDULUM.replace('damping="0.01"', 'range="10 20"')
    assert reasons(nc.io.load(text))["hinge"].startswith("it starts beyond its limit")
    assert "hinge" not in reasons(nc.io.load(text, leave_out=("limits",)))
    limit = LIMIT.replace('lower="0"', 'lower="2"')
    crossed = f'<robot name="r">{link("a")}{link("b")}{joint("j", "revolute", "a", "b", more=limit)}</robot>'
    assert reasons(nc.io.load(crossed))["the limits of j"].startswith("the lower one, 2, is above the upper")


def test_flags_of_a_file_are_respected():
    flags = '<option><flag gravity="disable" damper="disable"/></option>'
    text = nc.io.PENDULUM.replace("<worldbody>", f"{flags}<worldbody>")
    robot = nc.io.load(text)
    assert robot.joints["hinge"].damping == 0 and not np.any(robot.description.gravity)


def test_from_a_file(tmp_path):
    (tmp_path / "arm.urdf").write_text(MACHINE, encoding="utf-8")
    assert nc.io.load(tmp_path / "arm.urdf").bodies == machine().bodies
    assert nc.io.load(str(tmp_path / "arm.urdf")).description.name == "machine"


# --- out again --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_saved_moves_with_mujoco_as_here(tmp_path):
    """Joints of every kind that is written, one of them used backwards, one on a body without mass."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(1.0, 2.0, -8.0)))
    bodies = []
    for k, place in enumerate(np.random.default_rng(0).normal(size=(8, 3))):
        link = nc.RigidBody(
            mass=1.0 + k, inertia=(0.2, 0.3, 0.4), com=(0.1, 0.0, 0.2), position=place,
            orientation=((1.0, k, 0.5), 0.3 * k), name=f"link {k}",
        )  # fmt: skip
        bodies.append(scene.add(link))
    chain = [
        nc.Revolute(nc.ground, bodies[0], axis=(0, 1, 1), zero=0.2, name="hinge"),
        nc.Cylindrical(bodies[0], bodies[1], axis=(1, 0, 1), name="cylinder"),
        nc.Planar(bodies[2], bodies[1], axis=(1, 1, 0), name="plane"),
        nc.Universal(bodies[3], bodies[2], axis=(1, 0, 0), second=(0, 0, 1), name="cardan"),
        nc.Prismatic(bodies[4], bodies[0], axis=(0, 0, 1), zero=-0.1, name="slide"),
        nc.Spherical(bodies[4], bodies[5], point=(0.3, 0.2, 0.1), name="socket"),
        nc.Fixed(bodies[5], bodies[6], name="flange"),
    ]
    joints = {joint.name: scene.add(joint) for joint in chain}
    hinge, slide = joints["hinge"], joints["slide"]
    scene.add(nc.JointSpring(hinge, stiffness=30.0, rest=0.4, name="spring"))
    scene.add(nc.JointDamper(slide, damping=2.0, name="damper"))
    scene.add(nc.Armature(hinge, inertia=0.3, name="rotor"))
    scene.add(nc.JointForce(slide, gear=2.0, name="push"))
    for name in ("hinge", "cylinder", "cardan", "plane", "slide"):
        scene.add(nc.JointTorque(joints[name], gear=0.5, name=f"motor of {name}"))
    scene.add(nc.AffineActuator((hinge, slide), gear=(1.0, -2.0), bias=(0.1, -3.0, -0.2), name="pull"))
    scene.add(nc.Spring((nc.Point(nc.ground), nc.Point(bodies[7])), stiffness=1.0, name="string"))
    system, state = scene.compile()
    state = nc.random_state(system, state, key=jax.random.key(0), coordinates=0.5, rates=0.7)
    saved = nc.io.save_mjcf(system, state, tmp_path / "chain.xml")
    assert [note.part for note in saved.notes] == ["motor of slide", "string"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "chain.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    driven = [name != "motor of slide" for name in system.structure.inputs]
    inputs = np.where(driven, np.linspace(0.7, -1.3, len(driven)), 0.0)
    for name, value in zip(system.structure.inputs, inputs):
        if value:
            data.actuator(name).ctrl[0] = value
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    # The string is not written, so it is made slack here.
    rows = system.set("string", stiffness=0.0).instant(state, inputs).accelerations.reshape(-1, 4, 3)
    for name in system.structure.bodies:
        number, twist = system.body_index(name), np.zeros(6)
        np.testing.assert_allclose(state.q[4 * number], data.body(name).xpos, atol=1e-12)
        kind = mujoco.mjtObj.mjOBJ_XBODY
        mujoco.mj_objectAcceleration(model, data, kind, data.body(name).id, twist, 0)
        np.testing.assert_allclose(rows[number, 0], twist[3:] + model.opt.gravity, rtol=1e-9, atol=1e-9)


def test_motors_are_saved_and_what_hangs_on_nothing_is_refused():
    """The README's own scene, and names with quotes."""
    scene = nc.Scene()
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.09, 0.09), com=(0.5, 0, 0), name='Bob\'s "rod"'))
    scene.add(
        nc.JointTorque(scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge")), name="motor")
    )
    scene.add(nc.PointOnPoint((nc.Point(nc.ground, (1, 0, 0)), nc.Point(rod, (1, 0, 0))), name="pin"))
    saved = nc.io.save_mjcf(*scene.compile())
    model = mujoco.MjModel.from_xml_string(saved.text)
    assert model.actuator("motor").trnid[0] == model.joint("hinge").id
    assert model.body(model.site("pin end 2").bodyid[0]).name == 'Bob\'s "rod"'


# --- errors -----------------------------------------------------------------------------------------------


def test_errors_say_what_to_do():
    wrong = [
        ("nowhere.urdf", FileNotFoundError, "there is no file 'nowhere.urdf'"),
        (3, ValueError, "source is an object of type int; pass the path"),
        ("<robot", ValueError, "no XML"),
        (
            '<robot xmlns:xacro="x"><xacro:property name="m"/></robot>',
            ValueError,
            "xacro robot.xacro > robot",
        ),
        ("<html/>", ValueError, "root <html>; pass URDF"),
        (
            "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>",
            ValueError,
            r"mass and inertia.*; give it a mass \[kg\]",
        ),
        (
            f'<robot name="r">{link("a")}{link("b", -1.0)}{joint("j", "continuous", "a", "b")}</robot>',
            ValueError,
            r"link 'b': mass \[kg\] is -1; give it a positive one",
        ),
        ("<mujoco><nonsense/></mujoco>", ValueError, "does not read it"),
    ]
    for source, error, words in wrong:
        with pytest.raises(error, match=words):
            nc.io.load(source)


def test_without_mujoco_the_line_to_install_it_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install \"natcoord-jax\[io\]\""):
        nc.io.load(nc.io.PENDULUM)


def test_only_robots_are_placed_by_add():
    scene = nc.Scene()
    with pytest.raises(ValueError, match="Scene.add: position for an object of type Body"):
        scene.add(nc.PointMass(mass=1.0), position=(1, 0, 0))
    with pytest.raises(ValueError, match=r"Scene.add: position \[m\] is 'here'"):
        scene.add(nc.io.load(nc.io.PENDULUM), position="here")
