"""What the laws of mechanics say about a trajectory: energies, momenta, impulses, and the scales of errors.

Computed from rows, velocities and mass blocks alone, in numpy, independently of the diagnostics of the
library (`test_conservation` compares the two). Only stored energies and constraints are the library's.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import NDArray


@eqx.filter_jit
def _library(system: Any, trajectory: Any) -> tuple[dict, dict, Any]:
    return system.energy(trajectory).stores, system.work(trajectory), system.constraint_errors(trajectory)


@dataclass
class Account:
    """Energies [J], momenta and constraint errors at every saved time.

    Attributes:
        kinetic: shape (t,).
        stores: stored energies by name, shape (t,).
        works: work done so far by name, shape (t,).
        momenta: of every body, shape (t, bodies, 3).
        spins: angular momenta about the origin of every body, shape (t, bodies, 3).
        directors: largest |d_i . d_j - delta_ij|.
        joints: largest violation of a joint.
        turned: largest angle [rad] any body has turned from its first orientation.
    """

    kinetic: NDArray
    stores: dict[str, NDArray]
    works: dict[str, NDArray]
    momenta: NDArray
    spins: NDArray
    directors: float
    joints: float
    turned: float

    @property
    def energy_scale(self) -> float:
        """Largest T + sum |V| + sum |W|."""
        parts = [self.kinetic, *self.stores.values(), *self.works.values()]
        return float(np.max(np.sum(np.abs(parts), axis=0)))

    @property
    def energy_error(self) -> float:
        """Largest change of energy less work, in terms of its scale."""
        balance = self.kinetic + sum(self.stores.values()) - sum(self.works.values())
        return relative(np.max(np.abs(balance - balance[0])), self.energy_scale)

    def momentum_error(self, impulse: NDArray | float = 0.0) -> float:
        """Largest change of momentum less impulse, in terms of the largest sum of |p_b|."""
        total = self.momenta.sum(axis=1) - impulse
        return relative(np.max(np.abs(total - total[0])), np.max(np.sum(_norm(self.momenta), axis=1)))

    def spin_error(self, axes: Any = (0, 1, 2), impulse: float = 0.0) -> float:
        """The same for components of the angular momentum; `impulse`: integral of |u|, part of the scale."""
        total = self.spins.sum(axis=1)[:, list(axes)]
        scale = np.max(np.sum(_norm(self.spins), axis=1)) + impulse
        return relative(np.max(np.abs(total - total[0])), scale)

    def exchanged(self) -> dict[str, float]:
        """Range of each store in terms of the energy that moves: the largest sum above the lowest levels."""
        parts = {"kinetic": self.kinetic, **self.stores}
        above = sum(np.abs(values - np.min(values)) for values in parts.values())
        return {name: float(np.ptp(values) / np.max(above)) for name, values in parts.items()}


def relative(error: Any, scale: Any) -> float:
    """Error over scale; 0 where the scale is 0."""
    return float(error / scale) if scale > 0 else 0.0


def _norm(vectors: NDArray) -> NDArray:
    return np.linalg.norm(vectors, axis=-1)


def rows(array: Any) -> NDArray:
    """Rows by body: shape (t, bodies, 4, 3)."""
    array = np.asarray(array)
    return array.reshape(*array.shape[:-2], -1, 4, 3)


def account(system: Any, trajectory: Any) -> Account:
    """The account of a trajectory."""
    q, v, mass = rows(trajectory.q), rows(trajectory.v), np.asarray(system.mass)
    impulses = np.einsum("kab,tkbc->tkac", mass, v)
    stores, works, errors = _library(system, trajectory)
    d = q[:, :, 1:]
    gram = np.einsum("tkic,tkjc->tkij", d, d)
    cosines = (np.einsum("tkic,kic->tk", d, d[0]) - 1.0) / 2.0
    return Account(
        kinetic=0.5 * np.einsum("tkac,tkac->t", impulses, v),
        stores={name: np.asarray(x) for name, x in stores.items()},
        works={name: np.asarray(x) for name, x in works.items()},
        momenta=impulses[:, :, 0],
        spins=np.sum(np.cross(q, impulses), axis=2),
        directors=float(np.max(np.abs(gram - np.eye(3)))),
        joints=float(np.max(errors.joints)),
        turned=float(np.max(np.arccos(np.clip(cosines, -1.0, 1.0)))),
    )
