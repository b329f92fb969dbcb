"""GravityFeatures: gravity against the plane of the feet, as inputs of the assessor."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import gravity_in_foot_plane


class GravityFeatures(LeafSystem):
    """Shows the slope of the ground, which the state relative to the feet does not.

    .. pydrake_system::

        name: GravityFeatures
        input_ports:
        - plant_state: n_q + n_v
        - gravity: 3
        output_ports:
        - features: 2

    The features are the components of gravity's direction in the plane of the feet, (2,), see
    :func:`~drake_safety.control.observation.gravity_in_foot_plane`. ``gravity`` (3,) is in the
    world in which ``plant_state`` is measured: on an actual robot, whose attitude is estimated
    from gravity, a constant.

    Args:
        mirror: If given, the features are those of the robot's mirror image.
    """

    def __init__(self, kinematics: RobotKinematics, *, mirror: Mirror | None = None):
        super().__init__()
        self._kinematics, self._mirror = kinematics, mirror
        n_q = self._n_q = kinematics.num_positions
        self.feature_names = ["gravity_x", "gravity_y"]
        self._state_port = self.DeclareVectorInputPort(
            "plant_state", n_q + kinematics.num_velocities
        )
        self._gravity_port = self.DeclareVectorInputPort("gravity", 3)
        self.DeclareVectorOutputPort("features", BasicVector(2), self._calc_features)

    def _calc_features(self, context: Context, output: BasicVector) -> None:
        gravity = gravity_in_foot_plane(
            self._kinematics,
            self._state_port.Eval(context)[: self._n_q],
            self._gravity_port.Eval(context),
        )
        output.SetFromVector(gravity if self._mirror is None else gravity * (1.0, -1.0))
