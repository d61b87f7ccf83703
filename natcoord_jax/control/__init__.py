"""Optimal control of the discrete motion, on top of the rollout."""

from natcoord_jax.control import bounds as bounds
from natcoord_jax.control import cost as cost
from natcoord_jax.control import goal as goal
from natcoord_jax.control import inputs as inputs
from natcoord_jax.control.check import Check as Check
from natcoord_jax.control.check import check as check
from natcoord_jax.control.computed_torque import ComputedTorque as ComputedTorque
from natcoord_jax.control.computed_torque import computed_torque as computed_torque
from natcoord_jax.control.descent import descend as descend
from natcoord_jax.control.feedback import Feedback as Feedback
from natcoord_jax.control.feedback import receding_horizon as receding_horizon
from natcoord_jax.control.feedback import regulator as regulator
from natcoord_jax.control.guess import Guess as Guess
from natcoord_jax.control.inverse import inverse_dynamics as inverse_dynamics
from natcoord_jax.control.nlp import NonlinearProgram as NonlinearProgram
from natcoord_jax.control.nlp import to_nlp as to_nlp
from natcoord_jax.control.parameter import Parameter as Parameter
from natcoord_jax.control.problem import OptimalControl as OptimalControl
from natcoord_jax.control.results import Outcome as Outcome
from natcoord_jax.control.run import multi_start as multi_start
from natcoord_jax.control.run import optimise as optimise
from natcoord_jax.control.run import optimise_jit as optimise_jit
from natcoord_jax.control.sensitivity import optimum as optimum
from natcoord_jax.control.solution import Solution as Solution
from natcoord_jax.control.solution import load_guess as load_guess
