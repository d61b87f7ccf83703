"""Contact of bodies with shapes, planes, beams, and the surfaces of shells and solids."""

from itertools import combinations
from typing import Any

import equinox as eqx

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.bodies.contact_gaps import gaps_between, gaps_within
from natcoord_jax.bodies.contact_search import are_searched, searched_contacts, what_a_search_wants
from natcoord_jax.bodies.contact_sides import BeamSide, BodySide, MeshSide, PlaneSide, SegmentSide, Side
from natcoord_jax.bodies.contact_sides import Plane as Plane
from natcoord_jax.bodies.mesh_handle import MeshHandle, Surface
from natcoord_jax.bodies.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.bodies import Body
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY, FLAG, NAME, Choice, HandleOf, Several, of
from natcoord_jax.core.markers import Point
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.recipe import Builder, Recipe

SOLID = (
    HandleOf("body")
    | of(
        "what scene.add(nc.Shell(...)) or scene.add(nc.Solid(...)) returned, or faces of it",
        MeshHandle,
        Surface,
    )
    | of("what scene.add(nc.Beam(...)) returned", BeamHandle)
)
SIDE = SOLID | of("nc.Plane(...)", Plane)

MOST = 2000
"""Gaps of all pairs of some bodies that are made one by one."""

SHAPES = "nc.Sphere, nc.Capsule, nc.Box, nc.Cylinder, nc.Ellipsoid or a point"


def _tuple(given: Any) -> Any:
    """What is static is hashable."""
    return tuple(map(_tuple, given)) if isinstance(given, list | tuple) else given


class Contact(Recipe):
    """Contact of a body with a plane or with another body, or of some bodies with each other.

    Without a stiffness, rigid bodies do not overlap (`nc.GapConstraint`): impacts leave a part `restitution`
    of the speed of closing, whatever the step, and surfaces may rub (`friction`). Energy is exact but for
    what impacts and friction lose, which is in the account of the contact. That is for steps of order two,
    and derivatives are those of the program.

    With a stiffness, and where shells and solids are touched, the surfaces may overlap a little: an energy of
    the overlap pushes them apart. At an impact of speed v a mass m goes v sqrt(m / stiffness) deep, whatever
    the step; a contact lasts pi sqrt(m / stiffness), and for rebounds and gradients that are good to 5 % it
    wants six steps of that. Energy, momentum and angular momentum are exact, at impacts of any number of
    bodies, too.

    There are gaps for spheres, capsules, boxes (by their corners), cylinders (without a stiffness),
    ellipsoids, points, beams and the nodes of shells and solids on planes; for spheres, capsules and beams on
    each other and on points and nodes; for spheres, points, nodes, capsules and beams on boxes; for boxes on
    each other, with edges and corners that are a little round; and for surfaces of shells and solids on each
    other, nodes of either on the facets of the other, each with half the stiffness. Other shapes touch a
    shell or a solid at its nodes only: what is smaller than its cells slips through. Where a step is longer
    than a body, it may pass another without ever overlapping with it.

    Of fifty spheres and capsules or more in `all_pairs_of`, with a stiffness and without friction, only
    neighbours are looked at, see `nc.CapsuleContacts`; they are one contact with one name and without a
    sensor. `nc.contacts` tells of those of its pairs that come near, as if they were listed.

    Shells are touched from both sides, where their thickness ends; solids from outside, best at all that is
    outside, since at the end of a surface nodes slip off it. Which facets a node may touch is settled
    where the scene is compiled: those `candidates` that are the nearest to it in the assembled pose. Of a
    node that leaves them where the surface goes on, so that it may pass through, a run warns by name.

    Attributes:
        one: handle of a body with a shape, of a point mass or a node, of a beam, of a shell or a solid, or
            faces of these, as block.face("x1"); or `nc.Plane`.
        other: another of these.
        all_pairs_of: instead of these, handles of bodies that are in contact each with each other, but for
            pairs that a joint is between which was added before.
        ignore: pairs of them that are not, as [(one, other)].
        stiffness: k [N/m] of each contact: of each corner of a box on a plane, of each node; with law="hertz"
            [N/m^1.5], for spheres 4/3 E* sqrt(R). None: that of the elements at a node of a shell or a solid
            along their normal, modulus times area over thickness; of rigid bodies none, they do not overlap.
        restitution: part of the closing speed that is left after an impact [-]; None: nothing is lost. With a
            stiffness above 0, and where no other force acts (weight in a soft contact takes some more of it).
        friction: coefficient [-], of rigid bodies, points, beams, nodes of solids on planes, and of surfaces
            by their nodes; None: there is none.
        speed: with a stiffness, of the impact that `restitution` is of [m/s]; less is lost of slower ones.
        law: force proportional to the overlap, "linear", or to its power 3/2, "hertz".
        method: of two surfaces, "nodes" of each on the facets of the other, or "mortar": gaps of the facets
            of `one` over those of `other`, on average at each node of `one`. It costs more, and a uniform
            pressure passes exactly from one mesh to the other. Take the finer surface for `one`, and for
            `stiffness` one per area [N/m^3].
        one_pass: of two surfaces, let the nodes of `one` alone touch the facets of `other`, with all of the
            stiffness: for a fine surface, or one that folds, on a coarse one.
        self_contact: of a beam that is passed twice: its segments touch each other, those that are farther
            apart along it than half a turn about its own section.
        rounding: of two boxes, radius of their edges and corners where they touch each other [m], below half
            of the shortest edge; None: a fiftieth of that. Edges that move by more than two of these in a
            step, or overlap by as much in a soft contact, may pass each other.
        candidates: number of facets that a node may touch; default 16.
        capacity: of all pairs of spheres and capsules, neighbours that each has room for; default 16. Given,
            they are looked for of fewer than 50, too.
        skin: by how much two of them together may stray in a step from where their velocities take them [m];
            default a quarter of the largest radius. Steps in which one strays by half of it are made in
            parts.
        name: of the contact; several gaps are called "name[0]" and so on, those of all pairs
            "name[one, other]" or "name[one, other, 0]" by the names of the bodies.

    Raises:
        ValueError: when it is added: for shapes that there is no gap for, a surface against itself, no
            stiffness, or more than 2000 gaps of all pairs of bodies; for a capacity or skin of others than
            spheres and capsules. When the scene is compiled: for surfaces
            that overlap from the start.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity())
        >>> ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.03), density=400.0, position=(0, 0, 0.5)))
        >>> bounce = scene.add(nc.Contact(ball, nc.Plane(normal=(0, 0, 1)), stiffness=5e3))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=1e-3, steps=500)
        >>> float(nc.balance(system, trajectory).energy.max()) < 1e-12
        True
    """

    one: Any = eqx.field(default=None, metadata=is_a(SIDE))
    other: Any = eqx.field(default=None, metadata=is_a(SIDE))
    all_pairs_of: Any = eqx.field(
        default=None, kw_only=True, static=True, converter=_tuple, metadata=is_a(Several(BODY))
    )
    ignore: Any = eqx.field(
        default=(), kw_only=True, static=True, converter=_tuple, metadata=is_a(Several(Several(BODY, 2, 2)))
    )
    stiffness: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    restitution: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    friction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    speed: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    law: str = eqx.field(
        default="linear", kw_only=True, static=True, metadata=is_a(Choice(("linear", "hertz")))
    )
    method: str = eqx.field(
        default="nodes", kw_only=True, static=True, metadata=is_a(Choice(("nodes", "mortar")))
    )
    one_pass: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))
    self_contact: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))
    rounding: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    candidates: int | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Whole(1)))
    capacity: int | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Whole(1)))
    skin: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "contact"

    def add_to(self, scene: Builder, name: str) -> tuple[Handle, ...]:
        """Add its gaps; their handles."""
        if self.all_pairs_of is not None:
            return self._add_pairs(scene, name)
        if self.one is None or self.other is None:
            raise ValueError(
                f"contact {name!r} is of what with what? Pass two sides, or bodies by all_pairs_of=[...]"
            )
        itself = _owner(self.one) == _owner(self.other)
        if itself != self.self_contact or (itself and not isinstance(self.one, BeamHandle)):
            raise ValueError(
                f"contact {name!r}: {_owner(self.one).name!r} would be in contact with itself, for which "
                "there is no gap; pass two different parts, or twice a beam with self_contact=True"
                if itself
                else f"contact {name!r}: self_contact=True is for a beam with itself; pass it twice"
            )
        law = self._law()
        one, other = (_side(scene, given, name) for given in (self.one, self.other))
        gaps = gaps_within(one, law, name) if itself else gaps_between(one, other, law, name)
        named = [name] if len(gaps) == 1 else [f"{name}[{k}]" for k in range(len(gaps))]
        return tuple(scene.add(replace_fields(gap, name=said)) for gap, said in zip(gaps, named))

    def _law(self) -> dict[str, Any]:
        """Numbers and options of its gaps, as far as they are given."""
        options = "restitution", "friction", "speed", "candidates", "rounding"
        law = {"stiffness": self.stiffness, "law": self.law}
        law |= {key: value for key in options if (value := getattr(self, key)) is not None}
        law |= {"method": self.method} if self.method != "nodes" else {}
        return law | ({"one_pass": True} if self.one_pass else {})

    def _add_pairs(self, scene: Builder, name: str) -> tuple[Handle, ...]:
        """Add the gaps of all pairs of bodies; their handles."""
        law, made = self._law(), []
        sides = {handle: _side(scene, handle, name) for handle in self.all_pairs_of}
        pairs, every = self._pairs(scene, name), list(sides.values())
        search = {key: x for key in ("capacity", "skin") if (x := getattr(self, key)) is not None}
        if are_searched(every, law, search, name):
            return (scene.add(searched_contacts(every, pairs, law, search, name)),)
        for left, (one, other) in zip(range(len(pairs))[::-1], pairs):
            said = f"{one.name}, {other.name}"
            boxes = sides[one].kind is sides[other].kind is Box
            own = law if boxes else {key: value for key, value in law.items() if key != "rounding"}
            gaps = gaps_between(sides[one], sides[other], own, f"{name}[{said}]")
            several = len(gaps) > 1
            made += [
                (f"{name}[{said}, {k}]" if several else f"{name}[{said}]", g) for k, g in enumerate(gaps)
            ]
            if len(made) + left > MOST:
                raise ValueError(
                    f"contact {name!r}: all pairs of {len(sides)} bodies have more than {MOST} gaps, each of "
                    "which is made and looked at in every step; pass fewer bodies, or more pairs to "
                    f"`ignore`. To have near ones looked for instead: {what_a_search_wants(every, law)}"
                )
        return tuple(scene.add(replace_fields(gap, name=said)) for said, gap in made)

    def _pairs(self, scene: Builder, name: str) -> list[tuple[Handle, Handle]]:
        """Pairs of bodies that may touch."""
        bodies = self.all_pairs_of
        if self.one is not None or self.other is not None or self.self_contact:
            raise ValueError(
                f"contact {name!r}: all_pairs_of is instead of two sides and of self_contact; pass one "
                "or the other"
            )
        if len(set(bodies)) < max(2, len(bodies)):
            raise ValueError(
                f"contact {name!r}: all_pairs_of has {len(bodies)} bodies, {len(set(bodies))} of them "
                "different; pass two or more, each once"
            )
        strange = next((x for pair in self.ignore for x in pair if x not in bodies), None)
        if strange is not None:
            raise ValueError(
                f"contact {name!r}: ignore names {strange.name!r}, which is not in all_pairs_of; pass "
                "pairs of those bodies"
            )
        ignored = {frozenset(pair) for pair in self.ignore}
        pairs = [p for p in combinations(bodies, 2) if frozenset(p) not in ignored and not scene.joined(*p)]
        if not pairs:
            raise ValueError(
                f"contact {name!r}: all pairs of all_pairs_of are ignored or have a joint between them; "
                "leave it out, or ignore fewer"
            )
        return pairs


def _owner(given: Any) -> Any:
    """The part that a side belongs to."""
    if isinstance(given, Plane):
        return given.body
    return given.handle if isinstance(given, Surface) else given


def _side(scene: Builder, given: Any, name: str) -> Side:
    """What is passed for a side."""
    if isinstance(given, Plane):
        return PlaneSide(given.body, Plane, given)
    if isinstance(given, BeamHandle):
        return BeamSide.of(given, name)
    if isinstance(given, MeshHandle | Surface):
        surface = given.face() if isinstance(given, MeshHandle) else given
        return MeshSide(surface.handle, Surface, surface)
    part = scene.find(given, f"contact {name!r}")
    if not isinstance(part, Body):
        raise ValueError(f"contact {name!r}: {given!r} has no surface; pass nc.Plane(body=...) for a plane")
    if part.shape is None:
        if part.oriented:
            raise ValueError(
                f"contact {name!r}: {given.name!r} has no shape; give it one: {SHAPES} (nc.PointMass)"
            )
        return SegmentSide.ball(Point(given))
    return _shaped(given, part.shape.shape, part.shape.centre, name)


def _shaped(handle: Handle, shape: Any, centre: Any, name: str) -> Side:
    """A body with a shape."""
    body = BodySide(handle, type(shape), shape, centre)
    if isinstance(shape, Sphere):
        return SegmentSide.ball(body.point(), shape.radius)
    if isinstance(shape, Capsule):
        half = 0.5 * shape.length
        return SegmentSide(
            handle, Capsule, (body.point((0, 0, -half)), body.point((0, 0, half))), shape.radius
        )
    if not isinstance(shape, Box | Cylinder | Ellipsoid):
        raise ValueError(
            f"contact {name!r}: {handle.name!r} is a {type(shape).__name__}; there are gaps for {SHAPES}"
        )
    return body
