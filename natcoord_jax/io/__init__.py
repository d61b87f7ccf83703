"""Robots in: URDF and MJCF files as parts of a scene. Needs MuJoCo, `pip install "natcoord-jax[io]"`."""

from natcoord_jax.io.description import Description as Description
from natcoord_jax.io.description import JointData as JointData
from natcoord_jax.io.description import Keyframe as Keyframe
from natcoord_jax.io.load import PENDULUM as PENDULUM
from natcoord_jax.io.load import load as load
from natcoord_jax.io.notes import Note as Note
from natcoord_jax.io.robot import Robot as Robot
from natcoord_jax.io.robot import RobotHandle as RobotHandle
from natcoord_jax.io.robot import Site as Site
from natcoord_jax.io.saving import Saved as Saved
from natcoord_jax.io.saving import save_mjcf as save_mjcf
