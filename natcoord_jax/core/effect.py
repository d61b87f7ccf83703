"""The protocol between the core and an effect: what it sees of the motion, what it answers.

An effect sees the rows of the bodies it touches at the start of the step and at the stages, and answers
with forces on those rows, torques, constraint rates and power. It never sees the system.
"""

import abc
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import Part
from natcoord_jax.core.callables import replace_fields as replace_fields
from natcoord_jax.core.motion import Motion, Response, SpreadTangents, StepContext


class Effect(Part):
    """Base of everything that acts on bodies.

    Class attributes:
        kind: name of the scope its operations carry in the compiled program.
        multipliers: number of Lagrange multipliers per instance and stage.
        unilateral: whether the multipliers are those of inequalities: nothing is held until it is reached.
        bounces: whether what an inequality stops is an impact, with an impulse at the end of the step.
        bends: whether its slope changes within the differences that Jacobians may be found by.
        inputs: number of input channels per instance.
        impulsive: whether forces, torques and power of its response are times the step (impulses, work).
        works: whether its power enters the work account of the state (non-potential effects).
        stores: whether it stores potential energy.
        elastic: whether its oscillations can be damped numerically: it gives `strain_rates` and `curvature`,
            and adds `StepContext.stress` to its gradients.
        rotors: number of stored coordinate rates per instance.
        shared: whether one module serves all instances, instead of one with stacked numbers.
        couples: whether bodies of neighbouring markers become neighbours in the spanning tree where no joint
            makes them so: elements of beams do, of which a chain then is a chain of bodies.
        spread: whether it is on so many bodies that its derivatives are not to be one dense matrix, as those
            of the gas in a shell: it gives `parts` and `spread_tangents`. Without multipliers.
        silent: whether it has no sensor.
        faces: numbers of the nodes round each face of an element, four each, for pictures.
        vectors: of each node of an element made by `on`: 1 for its point, 2 with a director, 4 with a triad.
        unit_directions: whether it asks of directions among its markers only where they point.
        derived: fields that follow from the others, see `renewed`.
        slips: field with a rate of slip, and the part of the speeds of the scene that it is by default.
        drawn: whether pictures show it as a link where it is between two points.
    """

    kind: ClassVar[str] = "effect"
    multipliers: ClassVar[int] = 0
    unilateral: ClassVar[bool] = False
    bounces: ClassVar[bool] = False
    bends: ClassVar[bool] = False
    inputs: ClassVar[int] = 0
    impulsive: ClassVar[bool] = False
    works: ClassVar[bool] = False
    stores: ClassVar[bool] = False
    elastic: ClassVar[bool] = False
    rotors: ClassVar[int] = 0
    shared: ClassVar[bool] = False
    couples: ClassVar[bool] = False
    spread: ClassVar[bool] = False
    silent: ClassVar[bool] = True
    faces: ClassVar[tuple[tuple[int, ...], ...]] = ()
    vectors: ClassVar[int] = 1
    unit_directions: ClassVar[bool] = False
    derived: ClassVar[tuple[str, ...]] = ()
    slips: ClassVar[tuple[str, float] | None] = None
    drawn: ClassVar[bool] = True

    @classmethod
    def on(
        cls, nodes: Any, connectivity: Any, *, each: Any = None, name: str | None = None, **shared: Any
    ) -> Any:
        """Elements of this kind on the nodes of a set, thousands at once.

        Args:
            nodes: a set of nodes, as `scene.add(nc.Nodes.points(...))` returned it.
            connectivity: numbers of the nodes of each element (elements, nodes) in the set.
            each: fields whose numbers differ from element to element, by name, leading axis elements.
            name: of the elements.
            shared: the other fields.

        Returns:
            Something to add to the scene.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> import numpy as np
            >>> scene = nc.Scene()
            >>> line = scene.add(nc.Nodes.points(np.linspace((0, 0, 0), (1, 0, 0), 5), mass=0.1))
            >>> pairs = np.stack([np.arange(4), np.arange(1, 5)], axis=1)
            >>> springs = scene.add(nc.Spring.on(line, pairs, stiffness=50.0, length=0.25))
            >>> system, state = scene.compile()
        """
        from natcoord_jax.core.elements import on

        return on(cls, nodes, connectivity, each, name, shared)

    def assembled_at(self, x: Float[Array, "k *m 3"]) -> "Effect":
        """This effect with the numbers that it takes from where its markers are in the assembled pose."""
        return self

    def renewed(self) -> "Effect":
        """This effect with its `derived` numbers as the others ask for; called when others have been set."""
        return self

    def mass_matrix(self) -> Float[Array, "k *m"] | None:
        """Mass that it brings to its marker vectors, points [kg] and directions [kg m^2]; None: none.

        Or, for each node, the matrix (k, m, m) of these and of what is between them [kg m]; or one matrix
        (k, m, k, m) of all of them, with what is between the nodes.
        """
        return None

    def quadratic(self, place: Array, rows: Float[Array, "k 4 3"]) -> Float[Array, " p"] | None:
        """What has to be at most quadratic in the rows: a residual, or invariants; None: nothing.

        What is not is refused at compile, of effects that are not the library's.
        """
        return None

    def volume_ratios(
        self, place: Float[Array, "n *place"], rows: Float[Array, "n b 4 3"]
    ) -> Float[Array, " n"] | None:
        """Smallest ratio of volumes (now over without stress) in each of `n` elements; None: they have none.

        A step that ends where one is not positive is repeated in parts, and at last ends the run.
        """
        return None

    def uncovered(self, place: Array, rows: Float[Array, "k 4 3"]) -> dict[str, Array]:
        """What it does not see at a state though it should, as the rest of a sentence, and whether it is so.

        Eager runs look after it at the states that are saved, and warn.
        """
        return {}

    def neighbours(
        self, place: Array, rows: Float[Array, "k 4 3"], rates: Float[Array, "k 4 3"], h: Float[Array, ""]
    ) -> Any:
        """What it looks up once, at the start of a step, and finds in `StepContext`; None: nothing.

        Without derivatives: numbers of what is near, say.

        Args:
            place: see `respond`.
            rows: of its bodies at the start.
            rates: their velocities there.
            h: step [s].
        """
        return None

    def missed(
        self, place: Array, found: Any, start: Array, rates: Array, end: Array, h: Float[Array, ""]
    ) -> Int[Array, "2 2"]:
        """Of an effect that looks up its neighbours: a pair of markers which it may have missed in a step.

        A step with such a pair is repeated in parts, and at last ends the run.

        Args:
            place: see `respond`.
            found: its neighbours.
            start: rows of its bodies at the start.
            rates: their velocities there.
            end: rows at the end.
            h: step [s].

        Returns:
            Numbers of two markers that have moved beyond where was looked, and of two that there was no room
            for; -1 where there are none.
        """
        raise NotImplementedError

    @abc.abstractmethod
    def respond(self, place: Array, motion: Motion, now: StepContext, lam: Float[Array, "s m"]) -> Response:
        """Forces, torques, constraint rates and power over a step.

        Args:
            place: how the effect sits on its bodies, constant weights made at compile.
            motion: of its bodies.
            now: time, step, inputs, joint coordinates.
            lam: its multipliers times the step [N s or N m s].
        """

    def responses(
        self, place: Array, motion: Motion, now: StepContext, lam: Float[Array, "n s m"]
    ) -> Response:
        """Responses of `n` instances with stacked numbers; leading axis n.

        By default `respond` of each of them. Where that is slow, write it for all of them at once.

        Args:
            place: of the instances, leading axis n.
            motion: of their bodies.
            now: leading axis n in inputs, coordinates and rates.
            lam: of the instances.
        """

        def one(effect, place, inputs, coordinates, rates, more, start, rows, row_rates, spin, held, lam):
            alone = StepContext(now.t, now.h, inputs, coordinates, rates, now.tableau, *more)
            return effect.respond(place, Motion(start, rows, row_rates, spin, held), alone, lam)

        axes = (None if self.shared else 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 0)
        numbers = self, place, now.inputs, now.coordinates, now.rates, (now.stress, now.neighbours)
        moving = motion.start, motion.rows, motion.rates, motion.spin, motion.force_rows
        return jax.vmap(one, in_axes=axes)(*numbers, *moving, lam)

    def tangents(
        self, place: Array, motion: Motion, now: StepContext, lam: Float[Array, "n s m"], *, turning: bool
    ) -> Float[Array, "n k s r k s r"] | None:
        """Derivatives of the wrenches on the bodies by their twists, nearly, of `n` instances, in formulas.

        For Newton's iteration, of an effect without multipliers. A wrench is a force [N] and a torque [N m]
        about the reference point, a twist the velocity of that point [m/s] and an angular velocity [rad/s];
        where none of the bodies is `turning`, forces and velocities are all there is.
        None, the default: they are found by differentiating the response of `linearised`.
        """
        return None

    @property
    def parts(self) -> Any:
        """Of an effect that is `spread`: numbers of the markers that belong together (parts, markers)."""
        return None

    def spread_tangents(
        self, place: Array, motion: Motion, now: StepContext, *, turning: bool
    ) -> SpreadTangents:
        """Of an effect that is `spread`, for `n` instances with one stage: see `tangents`, nearly."""
        raise NotImplementedError

    def linearised(self, place: Array, motion: Motion, now: StepContext, lam: Float[Array, "s m"]) -> Any:
        """Something with a `respond` that is nearly this effect's, and nearly its derivative, at this motion.

        Newton's iteration takes its Jacobian from it; an effect that is expensive to differentiate can
        answer with something cheaper.
        """
        return self

    def strain_rates(self, place: Array, motion: Motion, h: Float[Array, ""]) -> Float[Array, "s p"]:
        """Rates of the invariants that an elastic effect is a function of; h = 0: at one instant."""
        return jnp.zeros((motion.rows.shape[0], 0))

    def curvature(
        self, place: Array, rows: Float[Array, "k 4 3"], coordinates: Float[Array, " c"]
    ) -> Float[Array, "p p"]:
        """Second derivatives of the energy of an elastic effect by its invariants."""
        return jnp.zeros((0, 0))

    def cancelling(
        self, place: Array, rows: Float[Array, "k 4 3"], coordinates: Float[Array, " c"]
    ) -> tuple[Float[Array, ""], Float[Array, ""]] | None:
        """Terms that cancel in its forces at given rows, by which these are rounded; None: none do.

        What they would do along the whole of what they depend on [J], and how far a point moves then [m].
        Forces that are no differences are rounded as they are large, which the step knows of every effect.
        """
        return None

    def violation(
        self,
        place: Array,
        rows: Float[Array, "k 4 3"],
        coordinates: Float[Array, " c"],
        t: Float[Array, ""],
    ) -> Float[Array, " m"]:
        """Constraints g of an effect with multipliers at one time: zero where they are obeyed."""
        return jnp.zeros(0)

    def violation_rate(
        self,
        place: Array,
        rows: Float[Array, "k 4 3"],
        rates: Float[Array, "k 4 3"],
        spin: Float[Array, "k 3"],
        t: Float[Array, ""],
        passing: Any,
    ) -> Float[Array, " m"]:
        """Their rates, linear in velocities of the rows, angular velocities and how time passes (1 or 0)."""
        return jnp.zeros(0)

    def opening(self, place: Array, rows: Float[Array, "k 4 3"], coordinates: Array, t: Array) -> Array:
        """The violation, or what is none even where that vanishes in a pose which is not the effect's."""
        return self.violation(place, rows, coordinates, t)

    def opening_slope(self, place: Array, rows: Array, rates: Array, spin: Array, t: Array) -> Array:
        """How the opening changes at a fixed time, by what a state is assembled."""
        return self.violation_rate(place, rows, rates, spin, t, 0.0)

    def violation_units(self, place: Array, rows: Float[Array, "k 4 3"]) -> tuple[str, ...]:
        """Their units: "m", "rad", or "-" for cosines."""
        return ()

    def readings(self, place: Array, rows: Float[Array, "k 4 3"]) -> Any:
        """What its sensor shows: a pytree of arrays; for effects that are not `silent`."""
        return None

    def stored(
        self,
        place: Array,
        rows: Float[Array, "k 4 3"],
        coordinates: Float[Array, " c"],
        rates: Float[Array, " r"],
    ) -> Float[Array, ""]:
        """Energy stored [J] at given rows, joint coordinates and rotor rates."""
        return jnp.zeros(())
