"""Observation terms of locomotion policies."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(kw_only=True, eq=False)
class PolicyInput:
    """What observation terms are functions of.

    Attributes:
        R_WB: Orientation of the base, (3, 3).
        w_WB: Angular velocity of the base in the world, (3,) [rad/s].
        v_WB: Velocity of the base in the world, (3,) [m/s].
        positions: Joint positions less those of zero action, in the policy's order, (n_a,) [rad].
        rates: Joint rates, (n_a,) [rad/s].
        command: (v_x, v_y, ω_z), (3,) [m/s, rad/s].
        action: The last action, (n_a,).
        phases: Phases of the gait clock, in [-π, π], (n_p,) [rad].
    """

    R_WB: np.ndarray
    w_WB: np.ndarray
    v_WB: np.ndarray
    positions: np.ndarray
    rates: np.ndarray
    command: np.ndarray
    action: np.ndarray
    phases: np.ndarray


Term = Callable[[PolicyInput], np.ndarray]
TERMS: dict[str, Term] = {}
"""Registered terms by name."""


def observation_term(name: str) -> Callable[[Term], Term]:
    """Registers a function of a :class:`PolicyInput` as an observation term."""

    def register(term: Term) -> Term:
        if TERMS.setdefault(name, term) is not term:
            raise ValueError(f"observation term '{name}' is already registered")
        return term

    return register


def registered_terms() -> list[str]:
    """Names of all registered observation terms."""
    return sorted(TERMS)


# Names of Isaac Lab; those of the gait clock and of the parts of the command are Holosoma's.
observation_term("base_lin_vel")(lambda seen: seen.R_WB.T @ seen.v_WB)
observation_term("base_ang_vel")(lambda seen: seen.R_WB.T @ seen.w_WB)
observation_term("projected_gravity")(lambda seen: seen.R_WB.T @ _DOWN)
observation_term("velocity_commands")(lambda seen: seen.command)
observation_term("command_lin_vel")(lambda seen: seen.command[:2])
observation_term("command_ang_vel")(lambda seen: seen.command[2:])
observation_term("joint_pos_rel")(lambda seen: seen.positions)
observation_term("joint_vel_rel")(lambda seen: seen.rates)
observation_term("last_action")(lambda seen: seen.action)
observation_term("sin_phase")(lambda seen: np.sin(seen.phases))
observation_term("cos_phase")(lambda seen: np.cos(seen.phases))
observation_term("gait_phase")(
    lambda seen: np.concatenate([np.sin(seen.phases), np.cos(seen.phases)])
)
