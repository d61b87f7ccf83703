"""What is computed from systems and trajectories after a run."""

from natcoord_jax.analysis.accuracy import accuracy
from natcoord_jax.analysis.accuracy_table import Accuracy
from natcoord_jax.analysis.balance import Balance, balance
from natcoord_jax.analysis.contacts import Contacts, contacts
from natcoord_jax.analysis.growth import Growth, tangent_growth
from natcoord_jax.analysis.load_path import load_path
from natcoord_jax.analysis.modes import Modes, modes
from natcoord_jax.analysis.phases import Phases
from natcoord_jax.analysis.statics import Equilibrium, equilibrium

__all__ = [
    "Accuracy",
    "Balance",
    "Contacts",
    "Equilibrium",
    "Growth",
    "Modes",
    "Phases",
    "accuracy",
    "balance",
    "contacts",
    "equilibrium",
    "load_path",
    "modes",
    "tangent_growth",
]
