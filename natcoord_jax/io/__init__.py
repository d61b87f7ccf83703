"""Robots in and out: URDF and MJCF files. Needs MuJoCo, `pip install "natcoord-jax[io]"`.

Meshes in: files of gmsh. Needs gmsh, `pip install "natcoord-jax[mesh]"`.

All URDF of the package example-robot-data 6.0 and all MJCF of gymnasium 1.4 are read. Of dm-control 1.0.50
these are not, because MuJoCo itself refuses them: build_fruitfly/fruitfly.xml and floor.xml (bodies whose
only masses are meshes that do not come along), dog_v2/scene.xml (a texture of the same name twice), and of
the data of its tests test_model.xml, model_with_assets.xml and model_with_invalid_filenames.xml (incomplete
on purpose). Its schema.xml and attribute_test_schema.xml are no MJCF.
"""

from natcoord_jax.io.description import Description as Description
from natcoord_jax.io.description import JointData as JointData
from natcoord_jax.io.description import Keyframe as Keyframe
from natcoord_jax.io.load import PENDULUM as PENDULUM
from natcoord_jax.io.load import load as load
from natcoord_jax.io.mesh_file import read_mesh as read_mesh
from natcoord_jax.io.notes import Note as Note
from natcoord_jax.io.robot import Robot as Robot
from natcoord_jax.io.robot import RobotHandle as RobotHandle
from natcoord_jax.io.robot import Site as Site
from natcoord_jax.io.saving import Saved as Saved
from natcoord_jax.io.saving import save_mjcf as save_mjcf
