"""Meshes of boxes and of gmsh: volumes, faces from outside, and what a pressure on them pushes in all."""

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import DENSITY, LAWS

import natcoord_jax as nc
import natcoord_jax.io

LOADS = {4: nc.FacePressure, 6: nc.FacePressure6, 8: nc.FacePressure8, 9: nc.FacePressure9}


def pushed(mesh, faces):
    """What a pressure of one pushes on faces in all [N]."""
    load = LOADS[faces.shape[1]]
    one = load([nc.Point(nc.ground, x) for x in mesh.nodes[faces[0]]], pressure=1.0)
    x = jnp.asarray(mesh.nodes)
    return sum(np.asarray(one.load(x[f], None, None, 0.0).forces).sum(axis=0) for f in faces)


def mass_of(mesh):
    scene = nc.Scene()
    scene.add(nc.Solid(mesh, material=LAWS["neo-Hooke"]))
    return np.asarray(scene.compile()[0].mass)[:, 0, 0]


@pytest.mark.slow
def test_boxes_have_their_volume_and_faces_that_close():
    """Faces from outside, and the force of a pressure on all of them, which is none."""
    for element in ("hexahedron8", "hexahedron20", "hexahedron27", "tetrahedron10"):
        mesh = nc.mesh.box((1.0, 2.0, 0.5), (2, 1, 1), element=element)
        masses = mass_of(mesh)
        assert masses.sum() == pytest.approx(DENSITY, rel=1e-12), element
        assert masses.min() > 0, element
        close = {"atol": tol.SOME_ROUNDINGS, "err_msg": element}
        np.testing.assert_allclose(pushed(mesh, mesh.faces["x1"]), (-1.0, 0, 0), **close)
        np.testing.assert_allclose(pushed(mesh, mesh.outside), 0.0, **close)
        assert sum(len(x) for x in mesh.faces.values()) == len(mesh.outside), element


# --- files --------------------------------------------------------------------------------------------------


def written(folder, order, layers=0, serendipity=False):
    """A file of gmsh: a box of tetrahedra, or of hexahedra in layers, with groups."""
    try:
        gmsh = pytest.importorskip("gmsh")
    except OSError as missing:  # libraries of the system that its own needs
        pytest.skip(str(missing))
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.6)
    gmsh.option.setNumber("Mesh.SecondOrderIncomplete", serendipity)
    kernel, mesh = gmsh.model.occ, gmsh.model.mesh
    plate = kernel.addRectangle(0, 0, 0, 1, 0.5)
    kernel.extrude([(2, plate)], 0, 0, 0.5, numElements=[layers] if layers else [], recombine=bool(layers))
    kernel.synchronize()
    if layers:
        mesh.setTransfiniteSurface(plate)
        mesh.setRecombine(2, plate)
    for _, face in gmsh.model.getEntities(2):
        place = kernel.getCenterOfMass(2, face)[0]
        if min(place, 1 - place) < 1e-6:
            gmsh.model.addPhysicalGroup(2, [face], name="held" if place < 0.5 else "pushed")
    gmsh.model.addPhysicalGroup(1, [1], 7)
    gmsh.model.addPhysicalGroup(3, [1], name="rubber")
    mesh.generate(3)
    mesh.setOrder(order)
    gmsh.write(str(folder / "part.msh"))
    gmsh.finalize()
    return folder / "part.msh"


FILES = [
    (8, (1, 1, False)),
    pytest.param(10, (2, 0, False), marks=pytest.mark.slow),
    pytest.param(20, (2, 1, True), marks=pytest.mark.slow),
    pytest.param(27, (2, 1, False), marks=pytest.mark.slow),
]
"""Nodes of a cell, and how it is written."""


@pytest.mark.parametrize(("nodes", "how"), FILES)
def test_meshes_of_gmsh(tmp_path, nodes, how):
    """Nodes in our order: the volume is right, and a pressure on a face by its name shortens it."""
    mesh = nc.io.read_mesh(written(tmp_path, *how))
    assert mesh.cells.shape[1] == nodes
    assert sorted(mesh.faces) == ["held", "pushed"]
    assert sorted(mesh.sets) == ["7", "held", "pushed"]
    np.testing.assert_array_equal(mesh.nodes[mesh.sets["held"]][:, 0], 0.0)
    assert len(mesh.part("rubber").cells) == len(mesh.cells)
    assert mass_of(mesh).sum() == pytest.approx(250.0, rel=1e-9)
    close = {"atol": tol.SOME_ROUNDINGS}
    np.testing.assert_allclose(pushed(mesh, mesh.faces["pushed"]), (-0.25, 0, 0), **close)
    np.testing.assert_allclose(pushed(mesh, mesh.outside), 0.0, **close)


def test_meshes_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match="Tetrahedron.* of 4 nodes: .*ElementOrder = 2"):
        nc.io.read_mesh(written(tmp_path, 1))
    with pytest.raises(ValueError, match="there is no file"):
        nc.io.read_mesh(tmp_path / "none.msh")
