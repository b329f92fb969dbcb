"""Kinematic preview of the whole body while the hand follows a plan."""

import math

import numpy as np

from drake_safety.control.kinematics import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    RobotKinematics,
    dposv,
)
from drake_safety.control.whole_body_model import Hand, PointReference, WholeBodyModel
from drake_safety.control.whole_body_qp import task_errors
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD

_FOOT_WEIGHT = 1e4  # Task weights are at most some hundreds, so feet move by micrometres.
_MAX_ITERATIONS = 4
_LAST_ITERATIONS = (3, 6)  # Least and most iterations at the last sample.
_NEAR_M = 0.005  # Tolerance of the hand's position.


class KinematicPreview:
    """Positions of the whole body along a plan of its hand, with fixed feet.

    With equal gains of all tasks and no active limit, the whole-body controller follows the
    minimisers of Σ w_i |e_i(q)|² + w_posture |q_j - q_posture|² with fixed feet. These are computed
    by Gauss-Newton steps, more of them while the hand is off the plan.
    """

    def __init__(self, model: WholeBodyModel):
        self.model = model
        self.hand = model.hand

    @ONE_BLAS_THREAD
    def follow(self, q: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Positions (M, n_q) along a path (M, 3) [m] of the hand in the world, from ``q``."""
        model, kinematics = self.model, self.model.kinematics
        reference = model.reference(q)
        contacts = kinematics.contact_positions(q)
        posture = model.parameters.posture
        q = q.copy()
        positions = np.empty((len(path), len(q)))
        for sample, point in enumerate(path):
            reference.reaching = PointReference(position=point)
            least, most = _LAST_ITERATIONS if sample == len(path) - 1 else (1, _MAX_ITERATIONS)
            for iteration in range(most):
                kinematics.set_positions(q)
                miss = self.hand.present_position(kinematics) - point
                if iteration >= least and miss.dot(miss) < _NEAR_M**2:
                    break
                reached, J_feet = kinematics.present_contacts()
                J, error = task_errors(model, reference)
                weighted = model.task_weights * J
                H = J.T @ weighted
                H += model.H
                feet = J_feet.T @ J_feet
                feet *= _FOOT_WEIGHT
                H += feet
                g = error @ weighted + _FOOT_WEIGHT * ((contacts - reached).ravel() @ J_feet)
                g[NUM_BASE_VELOCITIES:] += posture.weight * (
                    reference.posture - q[NUM_BASE_POSITIONS:]
                )
                _, step, _ = dposv(H, g)
                # The Context still has the positions q.
                q += kinematics.plant.MapVelocityToQDot(kinematics.context, step)
                q[:4] /= math.sqrt(q[:4].dot(q[:4]))
            positions[sample] = q
        return positions


def chain_joints(kinematics: RobotKinematics, hand: Hand) -> list[int]:
    """Finds the joints between base and hand, as indices into the robot's joints."""
    plant = kinematics.plant
    instance = plant.GetModelInstanceByName(kinematics.robot.name)
    return [
        i
        for i, name in enumerate(kinematics.joint_names)
        if hand.body.index()
        in plant.GetBodiesKinematicallyAffectedBy([plant.GetJointByName(name, instance).index()])
    ]
