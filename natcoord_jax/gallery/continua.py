"""Shells and solids in free flight."""

import numpy as np

import natcoord_jax as nc
from natcoord_jax.effects.solids.brick import CORNERS
from natcoord_jax.gallery.example import Example


def _grid(sizes: tuple[float, ...], counts: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Places of the nodes of a regular mesh (n, axes), and their numbers along the axes."""
    lines = [np.linspace(0.0, size, count + 1) for size, count in zip(sizes, counts)]
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(sizes))
    return places, np.arange(len(places)).reshape([count + 1 for count in counts])


def plate(counts: tuple[int, int] = (6, 3)) -> Example:
    """A rubber plate that tumbles and bends, of shell elements."""
    size, thickness, density, E = (1.0, 0.5), 0.05, 1000.0, 5e5
    flat, number = _grid(size, counts)
    places = np.pad(flat, ((0, 0), (0, 1)))
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    quads = np.stack(corners, axis=-1).reshape(-1, 4)
    area = np.bincount(quads.ravel(), minlength=len(places)) * np.prod(size) / len(quads) / 4
    # A bending wave on top of a spin: directors turn with the surface.
    spin, wave, speed = np.array([0.5, 0.3, 4.0]), np.pi / size[0], 3.0
    velocity = np.cross(spin, places - places.mean(axis=0))
    velocity[:, 2] += speed * np.cos(2 * wave * places[:, 0])
    turning = np.zeros_like(places)
    turning[:, 1] = 2 * wave * speed * np.sin(2 * wave * places[:, 0])
    scene = nc.Scene()
    mesh = scene.add(
        nc.Nodes.directors(
            places,
            (0, 0, 1),
            mass=density * thickness * area,
            inertia=density * thickness**3 / 12 * area,
            velocity=velocity,
            angular_velocity=spin + turning,
            name="mesh",
        )
    )
    scene.add(nc.ShellElement.on(mesh, quads, thickness=thickness, E=E, nu=0.3, name="plate"))
    system, state = scene.compile()
    facts = {"dofs": 5 * len(places), "mass": density * thickness * float(np.prod(size))}
    return Example("plate", "a plate of shells", system, state, 1e-3, 1000, facts=facts)


def block(counts: tuple[int, int, int] = (4, 2, 2)) -> Example:
    """A rubber block that tumbles and is stretched, of bricks."""
    size, density, E = (1.0, 0.5, 0.5), 1000.0, 1e5
    places, number = _grid(size, counts)
    ends = {-1.0: slice(None, -1), 1.0: slice(1, None)}
    corners = [number[tuple(ends[c] for c in corner)] for corner in CORNERS]
    bricks = np.stack(corners, axis=-1).reshape(-1, 8)
    volume = np.bincount(bricks.ravel(), minlength=len(places)) * np.prod(size) / len(bricks) / 8
    velocity = np.cross((0.5, 0.3, 4.0), places - places.mean(axis=0))
    velocity[:, 0] += 6.0 * (places[:, 0] - 0.5)
    scene = nc.Scene()
    mesh = scene.add(nc.Nodes.points(places, mass=density * volume, velocity=velocity, name="mesh"))
    scene.add(nc.Brick.on(mesh, bricks, E=E, nu=0.3, name="block"))
    system, state = scene.compile()
    facts = {"dofs": 3 * len(places), "mass": density * float(np.prod(size))}
    return Example("block", "a block of bricks", system, state, 2e-3, 1000, facts=facts)
