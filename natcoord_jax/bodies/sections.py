"""Cross-sections of beams: stiffness and inertia per length, from shapes or from numbers.

Axes: d_1 and d_2 span the section, d_3 is the tangent. The strains (Gamma_1, Gamma_2, Gamma_3, K_1, K_2, K_3)
are shear along d_1 and d_2, stretch, bending about d_1 and d_2, torsion.
"""

from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, checked, is_a
from natcoord_jax.core.bodies import mass_block
from natcoord_jax.core.checks import as_array, is_concrete, numbers, positive, shape_of
from natcoord_jax.core.eager_numpy import eager_numpy, stacked
from natcoord_jax.core.numeric import Definite, Number, Numbers, Vector, masked

SIZE, PAIR, RIM = Number("positive"), Number("positive") | Numbers((2,), "positive"), Numbers((None, 2))
POISSON = Number(above=-1.0, most=0.5)
STIFFNESS, INERTIA = Definite((6, 6)), Definite((3, 3))


class Section(Part):
    """A cross-section by its numbers.

    Attributes:
        stiffness: C, shape (6, 6) [N, N m, N m^2].
        inertia: integrals of density times (1, theta^1, theta^2) products, shape (3, 3)
            [kg/m, kg, kg m]: mass per length, first and second moments; the second moment M^11 of theta^1 is
            the inertia about d_2.
        outline: points of the rim in the section, shape (n, 2) [m], for pictures.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=100.0, GJ=100.0, density=1.0, rotary=10.0)
        >>> [float(x) for x in section.stiffness.diagonal()]
        [10000.0, 10000.0, 10000.0, 100.0, 100.0, 100.0]
    """

    stiffness: Any = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(STIFFNESS))
    inertia: Any = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(INERTIA))
    outline: Any = eqx.field(default=None, kw_only=True, metadata=is_a(RIM))

    makes_arrays: ClassVar[bool] = True

    @classmethod
    @checked("Section.of_numbers")
    def of_numbers(
        cls,
        *,
        EA: Annotated[Any, SIZE],
        GA: Annotated[Any, PAIR],
        EI: Annotated[Any, PAIR],
        GJ: Annotated[Any, SIZE],
        density: Annotated[Any, SIZE],
        rotary: Annotated[Any, Number("not negative") | Numbers((2,), "not negative")] = 0.0,
        centre: Annotated[Any, Vector(2)] = (0.0, 0.0),
        outline: Annotated[Any, RIM] = None,
    ) -> "Section":
        """Section from its stiffnesses.

        Args:
            EA: along d_3 [N].
            GA: along d_1 and d_2 [N], shear coefficients included; one number for both.
            EI: about d_1 and d_2 [N m^2]; one number for both.
            GJ: about d_3 [N m^2].
            density: mass per length [kg/m].
            rotary: inertia per length about d_1 and d_2 through the centre of mass [kg m]; one number for
                both. That about d_3 is their sum.
            centre: centre of mass in the section (theta^1, theta^2) [m].
            outline: rim of the section (n, 2) [m], for pictures.

        Raises:
            ValueError: for a stiffness or density that is not positive, or a negative rotary inertia.
        """
        shear, bending = (_pair(v, f"section: {n}", u) for v, n, u in ((GA, "GA", "N"), (EI, "EI", "N m^2")))
        stretch, torsion = positive(EA, "section: EA", "N"), positive(GJ, "section: GJ", "N m^2")
        mass = positive(density, "section: density", "kg/m")
        about = numbers(_twice(rotary), (2,), "section: rotary", "kg m")
        offset = numbers(centre, (2,), "section: centre", "m")
        stiffness = _stiffness(shear, stretch, bending, torsion)
        return cls(stiffness, _inertia(mass, offset, about), outline=outline)

    @classmethod
    @checked("Section.of_axis_along_first")
    def of_axis_along_first(
        cls,
        stiffness: Annotated[Any, STIFFNESS],
        inertia: Annotated[Any, INERTIA],
        *,
        outline: Annotated[Any, RIM] = None,
    ) -> "Section":
        """Section from data with axis 1 along the beam and axes 2 and 3 across, as many codes have them.

        The axes (1, 2, 3) of the data are d_3, d_1, d_2 here: a cyclic exchange, which keeps hands.

        Args:
            stiffness: shape (6, 6), for (stretch, shear 2, shear 3, torsion, bending 2, bending 3).
            inertia: shape (3, 3), for (1, x_2, x_3) [kg/m, kg, kg m].
            outline: rim of the section (n, 2) [m], for pictures.
        """
        given = numbers(stiffness, (6, 6), "section: stiffness", "N, N m, N m^2")
        places = np.array([1, 2, 0, 4, 5, 3])
        return cls(given[np.ix_(places, places)], inertia, outline=outline)

    def lump(self, length: Float[Array, ""]) -> Float[Array, "4 4"]:
        """Mass block (15) of a node that carries a length [m] of the beam; d_3 is massless."""
        return jnp.zeros((4, 4)).at[:3, :3].set(length * self.inertia)


@eager_numpy
def _stiffness(shear: Array, stretch: Array, bending: Array, torsion: Array) -> Float[Array, "6 6"]:
    return jnp.diag(jnp.concatenate([shear, stretch[None], bending, torsion[None]]))


@eager_numpy
def _inertia(mass: Array, offset: Float[Array, "2"], about: Float[Array, "2"]) -> Float[Array, "3 3"]:
    second = jnp.diag(about[::-1]) + mass * jnp.outer(offset, offset)
    return mass_block(mass, offset, second)


def _twice(value: Any) -> Any:
    """A number for both axes; what is more than a number stays as it is."""
    return stacked([as_array(value, float)] * 2) if shape_of(value) == () else value


def _pair(value: Any, what: str, unit: str) -> Float[Array, "2"]:
    return numbers(_twice(value), (2,), what, unit)


def _elastic(shape: "Shaped", young: Any, poisson: Any, density: Any) -> Section:
    *moments, outline = shape
    young, density = positive(young, "section: E", "Pa"), positive(density, "section: density", "kg/m^3")
    found = _moduli(young, density, poisson, *moments)
    return Section.of_numbers(**found, outline=outline)


@eager_numpy
def _moduli(
    young: Array, density: Array, poisson: Array, area: Array, second: Array, torsion: Array, shear: Array
) -> dict[str, Array]:
    rigidity = young / (2 * (1 + poisson))
    return {
        "EA": young * area,
        "GA": shear * rigidity * area,
        "EI": young * second,
        "GJ": rigidity * torsion,
        "density": density * area,
        "rotary": density * second,
    }


Shaped = tuple[Array, Array, Array, Array, Array]
"""Area [m^2], its second moments about both axes and of torsion [m^4], shear coefficient [-], rim [m]."""


def _ellipse(first: Any, second: Any, points: int = 24) -> Array:
    angle = jnp.linspace(0.0, 2 * jnp.pi, points, endpoint=False)
    return jnp.stack([first * jnp.cos(angle), second * jnp.sin(angle)], axis=1)


@checked(radius=SIZE, E=SIZE, nu=POISSON, density=SIZE, shear=SIZE)
def CircularSection(*, radius: Any, E: Any, nu: Any = 0.3, density: Any, shear: Any = None) -> Section:
    """Full circle.

    Args:
        radius: [m].
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-], above -1 up to 1/2.
        density: [kg/m^3].
        shear: shear coefficient [-]; default 6 (1 + nu) / (7 + 6 nu) (Cowper 1966).

    Raises:
        ValueError: for numbers that no section has.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> rope = nc.CircularSection(radius=0.01, E=1e6, density=1000.0)
    """
    r, nu = positive(radius, "section: radius", "m"), POISSON.masked(as_array(nu, float))
    return _elastic(_circle(r, nu, shear), E, nu, density)


@eager_numpy
def _circle(r: Array, nu: Array, shear: Any) -> Shaped:
    area, second = jnp.pi * r**2, jnp.pi * r**4 / 4
    k = 6 * (1 + nu) / (7 + 6 * nu) if shear is None else SIZE.masked(jnp.asarray(shear, float))
    return area, second, 2 * second, k, _ellipse(r, r)


@checked(radius=SIZE, thickness=SIZE, E=SIZE, nu=POISSON, density=SIZE, shear=SIZE)
def TubularSection(
    *, radius: Any, thickness: Any, E: Any, nu: Any = 0.3, density: Any, shear: Any = None
) -> Section:
    """Circular tube; otherwise as `CircularSection`.

    Args:
        radius: the outer one [m].
        thickness: of the wall [m].
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-], above -1 up to 1/2.
        density: [kg/m^3].
        shear: shear coefficient [-].

    The default shear coefficient is Cowper's (1966), 6 (1 + nu) p / ((7 + 6 nu) p + (20 + 12 nu) m^2) with
    p = (1 + m^2)^2 and the ratio m of inner and outer radius.

    Raises:
        ValueError: for numbers that no section has, or a wall thicker than the radius.
    """
    r, t = positive(radius, "section: radius", "m"), positive(thickness, "section: thickness", "m")
    if is_concrete(r, t) and float(t) > float(r):
        raise ValueError(f"section: thickness [m] is {float(t):g}, more than the radius {float(r):g}")
    r, t = masked(r, lambda r: t <= r), masked(t, lambda t: t <= r)
    nu = POISSON.masked(as_array(nu, float))
    return _elastic(_tube(r, t, nu, shear), E, nu, density)


@eager_numpy
def _tube(r: Array, t: Array, nu: Array, shear: Any) -> Shaped:
    inner = r - t
    ratio = (inner / r) ** 2
    # (Of a thin wall a difference of squares would have few digits.)
    area = jnp.pi * t * (r + inner)
    second = area * (r**2 + inner**2) / 4
    part = (1 + ratio) ** 2
    cowper = 6 * (1 + nu) * part / ((7 + 6 * nu) * part + (20 + 12 * nu) * ratio)
    k = cowper if shear is None else SIZE.masked(jnp.asarray(shear, float))
    return area, second, 2 * second, k, _ellipse(r, r)


@checked(width=SIZE, height=SIZE, E=SIZE, nu=POISSON, density=SIZE, shear=SIZE)
def RectangularSection(
    *, width: Any, height: Any, E: Any, nu: Any = 0.3, density: Any, shear: Any = None
) -> Section:
    """Rectangle; otherwise as `CircularSection`.

    Args:
        width: along d_1 [m].
        height: along d_2 [m].
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-], above -1 up to 1/2.
        density: [kg/m^3].
        shear: shear coefficient [-].

    The default shear coefficient is 10 (1 + nu) / (12 + 11 nu) (Cowper 1966); torsion is Saint-Venant's
    series.

    Raises:
        ValueError: for numbers that no section has.
    """
    b, h = positive(width, "section: width", "m"), positive(height, "section: height", "m")
    nu = POISSON.masked(as_array(nu, float))
    return _elastic(_rectangle(b, h, nu, shear), E, nu, density)


@eager_numpy
def _rectangle(b: Array, h: Array, nu: Array, shear: Any) -> Shaped:
    area = b * h
    second = jnp.stack([b * h**3, b**3 * h]) / 12
    # Not the maximum, which gives a square the mean of both sides, and wrong second derivatives.
    long, short = jnp.where(b > h, b, h), jnp.where(b > h, h, b)
    odd = jnp.arange(1.0, 40.0, 2.0)
    series = jnp.sum(jnp.tanh(0.5 * odd * jnp.pi * long / short) / odd**5)
    torsion = long * short**3 / 3 * (1 - 192 / jnp.pi**5 * short / long * series)
    k = 10 * (1 + nu) / (12 + 11 * nu) if shear is None else SIZE.masked(jnp.asarray(shear, float))
    corners = jnp.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    return area, second, torsion, k, 0.5 * corners * jnp.stack([b, h])
