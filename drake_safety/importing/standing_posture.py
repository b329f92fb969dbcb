"""A standing posture from a URDF: feet under the hips, on level ground."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from drake_safety.importing.urdf_survey import Limb, Survey

# Hip height / leg length.
_SHARES = (0.8, 0.75, 0.85, 0.7, 0.65, 0.9, 0.6, 0.55, 0.5, 0.45, 0.4, 0.95)
_SPREAD_SHARES = (0.45, 0.5, 0.4, 0.55, 0.35, 0.3, 0.6)
_TOLERANCE_M = 1e-3
_LEVEL_M = 2e-3  # As `check` demands.
_CENTRAL = 0.5  # Share of the feet's polygon, from its centre, in which the centre of mass is.
_NUM_SHIFTS = 3  # Shifts of the feet to be under the centre of mass.
_STOP_RAD = 0.05  # Distance of the posture from joint stops.
_NUM_GUESSES = 10
_ENOUGH = 5  # Number of solutions to choose from.
_FREE_RAD = 2.5  # Range of a joint without stops.


def standing_posture(
    survey: Survey, legs: list[Limb], keyframes: Mapping[str, Mapping[str, float]]
) -> tuple[dict[str, float], str]:
    """Returns a standing posture [rad] and its source: a keyframe, such as home, or solved."""
    names = sorted(keyframes, key=lambda name: not re.search("home|stand", name.lower()))
    for name in names:
        posture = {joint: round(keyframes[name][joint], 4) for joint in survey.posture()}
        if _stands(survey, legs, posture):
            return posture, f"keyframe '{name}'"
    survey.rest_joints(survey.limits.keys() - {joint for leg in legs for joint in leg.joints})
    return solve_standing_posture(survey, legs), "solved: feet under the hips"


def _stands(survey: Survey, legs: list[Limb], posture: dict[str, float]) -> bool:
    """Whether feet are level, the centre of mass amid them, joints within stops, not all at 0."""
    survey.set_joints(posture)
    points = np.concatenate([survey.positions(leg) - [0, 0, leg.radius_m] for leg in legs])
    low, high = points.min(axis=0), points.max(axis=0)
    center = survey.center_of_mass()[:2]
    is_within = all(survey.limits[j][0] <= q <= survey.limits[j][1] for j, q in posture.items())
    is_bent = any(posture[joint] for leg in legs for joint in leg.joints)
    is_balanced = np.all((low[:2] < center) & (center < high[:2]))
    return bool(is_within and is_bent and high[2] - low[2] <= _LEVEL_M and is_balanced)


def solve_standing_posture(survey: Survey, legs: list[Limb]) -> dict[str, float]:
    """Solves for joint positions [rad] of level feet, with the centre of mass amid them."""
    survey.set_joints({})
    solvers = [_Leg(survey, leg, len(legs)) for leg in legs]
    posture = _solved(survey, solvers)
    for _ in range(_NUM_SHIFTS):
        points = np.concatenate([survey.positions(leg) for leg in legs])[:, :2]
        low, high = points.min(axis=0), points.max(axis=0)
        offset = survey.center_of_mass()[:2] - (low + high) / 2
        if np.all(np.abs(offset) <= _CENTRAL * (high - low) / 2 + _TOLERANCE_M):
            break
        for solver in solvers:
            solver.target = solver.target + offset
        try:
            posture = _solved(survey, solvers)
        except ValueError:  # The feet do not reach so far.
            break
    survey.set_joints(posture)
    return posture


def _solved(survey: Survey, solvers: list[_Leg]) -> dict[str, float]:
    is_spread = any(solver.is_spread for solver in solvers)
    out_of_reach = set()
    for share in _SPREAD_SHARES if is_spread else _SHARES:
        lowest = min(solver.hip[2] - share * solver.length for solver in solvers)
        solved: dict[str, float] = {}
        for solver in solvers:
            if (angles := solver.solve(lowest)) is None:
                out_of_reach.add(solver.limb.body)
                break
            solved |= dict(zip(solver.limb.joints, angles.tolist(), strict=True))
        else:
            survey.set_joints(solved)
            return {name: round(value, 4) for name, value in survey.posture().items()}
    what = f"the feet {sorted(out_of_reach)} cannot reach the ground under their hips"
    raise ValueError(f"no standing posture found: {what}. Are these all feet (--feet)?")


class _Leg:
    def __init__(self, survey: Survey, limb: Limb, num_legs: int):
        self.limb, self._survey = limb, survey
        limits = np.array([survey.limits[name] for name in limb.joints])
        limits = np.clip(limits, -_FREE_RAD, _FREE_RAD)
        room = np.minimum(_STOP_RAD, 0.1 * (limits[:, 1] - limits[:, 0]))
        self._bounds = limits[:, 0] + room, limits[:, 1] - room
        neutral = [survey.joint_origin(name) for name in limb.joints]
        foot = survey.positions(limb).mean(axis=0)
        hops = np.linalg.norm(np.diff([*neutral, foot], axis=0), axis=1)
        hip = int(np.argmax(hops > 0.6 * hops.max()))
        # The knee is the joint after the hip.
        self._hip_and_knee = limb.joints[hip], limb.joints[min(hip + 1, len(neutral) - 1)]
        self.hip = neutral[hip]
        self.length = float(hops[hip:].sum())
        self._R_BF = survey.pose(limb.body).rotation()
        across = foot - self.hip
        self.is_spread = abs(across[2]) < 0.3 * self.length
        outwards = across[:2] / max(float(np.linalg.norm(across[:2])), 1e-9)
        self.target = np.array([self.hip[0], foot[1]])
        if self.is_spread:
            self.target = self.hip[:2] + 0.5 * self.length * outwards
        self._forwards = 1.0 if num_legs == 2 else -1.0

    def _set(self, angles: np.ndarray) -> None:
        self._survey.set_joints(dict(zip(self.limb.joints, angles.tolist(), strict=True)))

    def solve(self, ground: float) -> np.ndarray | None:
        """Solves for angles that put the spheres' lowest points on the ground, under the hip."""
        from scipy.optimize import least_squares

        def errors(angles: np.ndarray) -> np.ndarray:
            self._set(angles)
            points = self._survey.positions(self.limb)
            heights = points[:, 2] - self.limb.radius_m - ground
            parts = [points[:, :2].mean(axis=0) - self.target, heights]
            if len(points) > 1:
                # The orientation at zero keeps the foot level.
                R_FF = self._R_BF.inverse() @ self._survey.pose(self.limb.body).rotation()
                turn = R_FF.ToAngleAxis()
                parts.append(0.1 * turn.angle() * np.asarray(turn.axis()))
            return np.concatenate(parts)

        def costs(angles: np.ndarray) -> np.ndarray:
            return np.concatenate([errors(angles), 1e-4 * angles])

        low, high = self._bounds
        rng = np.random.default_rng(0)
        solutions: list[np.ndarray] = []
        for index in range(_NUM_GUESSES):
            guess = rng.uniform(low, high) if index else np.clip(0.0, low, high)
            angles = least_squares(costs, guess, bounds=(low, high), max_nfev=40).x
            if np.abs(errors(angles)).max() <= _TOLERANCE_M:
                solutions.append(angles)
            if len(solutions) == _ENOUGH:
                break
        return min(solutions, key=self._penalty, default=None)

    def _penalty(self, angles: np.ndarray) -> float:
        self._set(angles)
        hip, knee = map(self._survey.joint_origin, self._hip_and_knee)
        bend = (knee - hip) / self.length
        wanted = bend[2] if self.is_spread else self._forwards * bend[0]
        return float(np.sum(angles**2) + (1.5 if wanted < -0.01 else 0.0))
