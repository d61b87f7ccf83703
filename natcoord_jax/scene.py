"""The scene: bodies, joints and effects by name, and their compilation to a system and a state."""

import itertools
from typing import Annotated, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from natcoord_jax.bodies.nodes import Nodes
from natcoord_jax.bodies.rigid import Orientation
from natcoord_jax.build import build
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.bodies import Body
from natcoord_jax.core.checks import as_array, is_concrete, require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.elements import Elements
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.kinds import BODY, FLAG, JOINT, NAME, Choice, HandleOf, of
from natcoord_jax.core.nodes import Clamp, NodeSet
from natcoord_jax.core.numeric import COMPONENTS, Definite, Number, Numbers
from natcoord_jax.core.recipe import Recipe
from natcoord_jax.core.state import State
from natcoord_jax.model.own_effects import check_degrees, warn_of_resultants
from natcoord_jax.stepping.assemble import assemble as assemble_state
from natcoord_jax.stepping.prepared import prepared
from natcoord_jax.system import System

PART = of(
    "a body, a joint, an effect, a beam, nodes or elements, as nc.RigidBody(...)",
    Body,
    Joint,
    Effect,
    Recipe,
    Nodes,
    Elements,
    Clamp,
)

NODES = of("some nodes of a set, as mesh[:4]", NodeSet)

_scene_numbers = itertools.count(1)


@eager_numpy
def _sum(one: Array, other: Array) -> Array:
    return one + other


@eager_numpy
def _placed(every: Array, numbers: np.ndarray, places: Array) -> Array:
    return every.at[numbers].set(places)


class Scene:
    """A list of bodies, joints and effects with names; host Python, compiled once.

    There is no gravity unless it is added.

    Example:
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> base = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="base"))
        >>> system, state = scene.compile()
        >>> system.structure.bodies
        ('base',)
    """

    def __init__(self):
        require_double("scene")
        self._number = next(_scene_numbers)
        self.bodies: dict[str, Body] = {}
        self.joints: dict[str, Joint] = {}
        self.effects: dict[str, Effect] = {}
        self.recipes: dict[str, Recipe] = {}
        self.nodes: dict[str, Nodes] = {}
        self.elements: dict[str, Elements] = {}
        self.clamps: dict[str, Clamp] = {}

    @checked("Scene.add", part=PART, name=NAME, position=COMPONENTS, orientation=Orientation())
    def add(
        self,
        part: Body | Joint | Effect | Recipe | Nodes | Elements | Clamp,
        *,
        name: str | None = None,
        position: Any = None,
        orientation: Any = None,
    ) -> Any:
        """Add a body, a joint, another effect, a recipe of several of them (a beam), or thousands at once.

        Args:
            part: what to add.
            name: of a robot, the prefix of the names of its parts; other parts have their names themselves.
            position: of a robot, where the origin of its file is put [m].
            orientation: of a robot, that of the axes of its file: matrix, quaternion (w, x, y, z) or
                (axis, angle [rad]).

        Returns:
            The handle that joints, effects and sensors refer to it with; of a recipe, what it returns; of
            nodes, their set.

        Raises:
            ValueError: for a duplicate name, a part of another scene, a joint of a body with itself, or a
                place for what has one itself.
        """
        placement = {"name": name, "position": position, "orientation": orientation}
        placement = {key: value for key, value in placement.items() if value is not None}
        if placement:
            part = self._moved(part, placement)
        store: dict[str, Any]
        if isinstance(part, Body):
            store, kind, label = self.bodies, "body", "body"
        elif isinstance(part, Joint):
            store, kind, label = self.joints, "joint", type(part).__name__.lower()
        elif isinstance(part, Effect):
            store, kind, label = self.effects, "effect", type(part).kind
        elif isinstance(part, Nodes):
            store, kind, label = self.nodes, "nodes", "nodes"
        elif isinstance(part, Elements):
            store, kind, label = self.elements, "effect", f"{type(part.effect).kind} elements"
        elif isinstance(part, Clamp):
            store, kind, label = self.clamps, "clamp", "clamp"
        else:
            store, kind, label = self.recipes, "recipe", part.kind
        given: str | None = getattr(part, "name", None)
        name = given or self._free_name(label)
        if name == ground.name or any(name in taken for taken in self._stores()):
            raise ValueError(f"the name {name!r} is taken in this scene; pass another `name`")
        if isinstance(part, Recipe):
            made = part.add_to(self, name)
            store[name] = part
            return made
        if isinstance(part, Nodes):
            store[name] = part
            places = np.asarray(part.position) if is_concrete(part.position) else part.position
            return NodeSet(name, self._number, np.arange(len(places)), places)
        self._check(part, name)
        store[name] = part
        handle = Handle(kind, name, self._number)
        if isinstance(part, Joint):
            for companion in part.companions(handle):
                self.add(companion)
        return handle

    def _moved(self, part: Any, placement: dict[str, Any]) -> Any:
        if not isinstance(part, Recipe):
            given = " and ".join(placement)
            raise ValueError(
                f"Scene.add: {given} for an object of type {type(part).__name__}, which says them itself; "
                "pass them when you make the part"
            )
        return part.at(**placement)

    def _stores(self) -> tuple[dict[str, Any], ...]:
        return self.bodies, self.joints, self.effects, self.recipes, self.nodes, self.elements, self.clamps

    @checked("Scene.joined", one=BODY, other=BODY)
    def joined(self, one: Handle, other: Handle) -> bool:
        """Whether a joint that was added before is between two bodies."""
        return any({one, other} == {joint.parent, joint.child} for joint in self.joints.values())

    def _free_name(self, label: str) -> str:
        numbered = (f"{label} {k}" for k in itertools.count(1))
        return next(name for name in numbered if not any(name in store for store in self._stores()))

    @checked("Scene.add_mass", handle=BODY, block=Definite((4, 4)))
    def add_mass(self, handle: Handle, block: Any) -> None:
        """Add mass to a body: a mass block m (4, 4) (15) in its own frame [kg, kg m, kg m^2].

        Raises:
            ValueError: if the handle is no body of this scene.
        """
        body = self.find(handle, "added mass")
        if not isinstance(body, Body):
            raise ValueError(f"added mass: {handle!r} is no body that can carry mass")
        self.bodies[handle.name] = replace_fields(
            body, mass_block=_sum(body.mass_block, as_array(block, float))
        )

    @checked("Scene.move_nodes", nodes=NODES, positions=Numbers((None, 3)))
    def move_nodes(self, nodes: NodeSet, positions: Any) -> None:
        """Put some nodes of a set elsewhere in the assembled pose; elements are without stress there.

        Args:
            nodes: of this scene.
            positions: (n, 3) [m].

        Raises:
            ValueError: for nodes of another scene.
        """
        if nodes.scene != self._number:
            raise ValueError(f"move_nodes: {nodes!r} are no nodes of this scene")
        whole = self.nodes[nodes.name]
        place = _placed(whole.position, nodes.numbers, as_array(positions, float))
        self.nodes[nodes.name] = replace_fields(whole, position=place)

    def _check_clamp(self, part: Clamp, name: str) -> None:
        owner = self.find(part.body, f"{name!r}")
        if part.nodes.scene != self._number:
            raise ValueError(f"{name!r} refers to {part.nodes!r}, which are no nodes of this scene")
        held = {h.name for clamp in self.clamps.values() for h in clamp.nodes}
        twice = next((h.name for h in part.nodes if h.name in held), None)
        if twice is not None:
            raise ValueError(f"{name!r}: node {twice!r} is clamped already")
        if owner is not None and not (isinstance(owner, Body) and owner.oriented):
            raise ValueError(f"{name!r}: {part.body.name!r} has no orientation; pass a rigid body")
        if owner is not None and part.body.name not in self.bodies:
            raise ValueError(f"{name!r}: {part.body.name!r} is a node of a set itself; pass a rigid body")

    def _check(self, part: Body | Joint | Effect | Elements | Clamp, name: str) -> None:
        """Every handle in the part must be of this scene."""
        if isinstance(part, Body):
            return
        if isinstance(part, Clamp):
            return self._check_clamp(part, name)
        part = part.effect if isinstance(part, Elements) else part
        if isinstance(part, Joint):
            if part.parent == part.child:
                raise ValueError(
                    f"joint {name!r} joins body {part.child.name!r} with itself; pass two bodies"
                )
            self._check_axes(part, name)
        flat = jax.tree.leaves(part, is_leaf=lambda x: isinstance(x, Handle | eqx.Module) and x is not part)
        for leaf in flat:
            handle = leaf if isinstance(leaf, Handle) else getattr(leaf, "body", None)
            if isinstance(handle, Handle):
                self.find(handle, f"{name!r}")

    def _check_axes(self, joint: Joint, name: str) -> None:
        if joint.second is not None and is_concrete(joint.axis, joint.second):
            axis, second = np.asarray(joint.axis, float), np.asarray(joint.second, float)
            if np.linalg.norm(np.cross(axis, second)) <= 1e-9 * np.linalg.norm(axis) * np.linalg.norm(second):
                raise ValueError(f"joint {name!r}: second [-] points along the axis; pass another direction")

    @checked("Scene.find", handle=BODY | JOINT | HandleOf("effect"), user=NAME)
    def find(self, handle: Handle, user: str = "a request") -> Body | Joint | Effect | None:
        """The part behind a handle; None for the ground.

        Raises:
            ValueError: if the handle is not of this scene.
        """
        if handle == ground:
            return None
        owner, _, number = handle.name.partition("[")
        if handle.kind == "body" and owner in self.nodes and handle.scene == self._number:
            return self.nodes[owner].body(int(number[:-1]))
        effects = {**self.effects, **{name: part.effect for name, part in self.elements.items()}}
        store = {"body": self.bodies, "joint": self.joints, "effect": effects}[handle.kind]
        if handle.scene != self._number or handle.name not in store:
            raise ValueError(
                f"{user} refers to {handle!r}, which is not part of this scene; "
                "pass handles that this scene's `add` returned"
            )
        return store[handle.name]

    @checked("Scene.compile")
    def compile(
        self,
        *,
        assemble: Annotated[bool, FLAG] = False,
        solver: Annotated[str | None, Choice(("reduced", "recursive", "sparse", "full"))] = None,
        t: Annotated[Any, Number()] = 0.0,
    ) -> tuple[System, State]:
        """Compile to a system (parameters and structure) and its initial state.

        Args:
            assemble: project positions and velocities onto the constraints (see `nc.assemble`); without it
                a gap is refused (inside jit: the state is NaN) and inconsistent velocities are projected with
                a warning (inside jit: without one).
            solver: "reduced", "recursive", "sparse" or "full"; default chosen from the structure (see
                `System.report`).
            t: time of the initial state [s], at which drives are and loads begin.

        Warns:
            UserWarning: of velocities that were projected, and of an effect of one's own that pushes or turns
                from within all bodies that it acts between.

        Raises:
            ValueError: for an empty scene, a gap in a joint (with its name and size), a body without inertia
                along a free motion, a solver that cannot handle the scene, or an effect of one's own whose
                residual or invariants are not at most quadratic (see `nc.testing.check_effect`).
        """
        if not self.bodies and not self.nodes:
            raise ValueError("the scene has no bodies; add one before compiling")
        parts = self.bodies, self.joints, self.effects, solver, self.nodes, self.elements
        system, state = build(*parts, list(self.clamps.values()))
        check_degrees(system, state)
        state = state.at_time(t)
        if assemble:
            state = assemble_state(system, state)
        warn_of_resultants(system, state)
        return prepared(system, state, assembled=assemble, chosen=solver)
