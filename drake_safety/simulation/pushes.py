"""Pushes: forces that act on a body of a robot for a while."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.framework import Context

from drake_safety.simulation.closed_loop import ClosedLoop


@dataclass(kw_only=True)
class Push:
    """One push: where, how hard, when."""

    body: str = ""
    """The robot's body that is pushed, at its centre of mass."""
    force_n: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """The force in the world, (3,) [N]."""
    time_s: float = 1.0
    """When it begins [s]."""
    duration_s: float = 0.1
    """How long it lasts [s]."""

    def __post_init__(self) -> None:
        if len(self.force_n) != 3 or not np.isfinite(self.force_n).all():
            raise ValueError(f"push: force_n must be three numbers [N]; got {self.force_n}")
        if not self.time_s >= 0:
            raise ValueError(f"push: time_s must not be negative; got {self.time_s}")
        if not self.duration_s > 0:
            raise ValueError(f"push: duration_s must be positive; got {self.duration_s}")

    @property
    def strength_n(self) -> float:
        """Magnitude of the force [N]."""
        return float(np.linalg.norm(self.force_n))


def begin_push(loop: ClosedLoop, context: Context, push: Push) -> None:
    """From now on a force acts on a body of the loop's robot.

    Args:
        loop: A closed loop with the input port ``applied_spatial_force``.
        context: Its root Context.
        push: Body and force; its times are the caller's to keep.

    Raises:
        ValueError: The robot has no such body.
    """
    plant, instance = loop.plant, loop.robot_instance
    if not plant.HasBodyNamed(push.body, instance):
        bodies = [plant.get_body(index).name() for index in plant.GetBodyIndices(instance)]
        raise ValueError(
            f"push: robot '{loop.robot.name}' has no body '{push.body}'; its bodies are {bodies}"
        )
    body = plant.GetBodyByName(push.body, instance)
    force = ExternallyAppliedSpatialForce()
    force.body_index = body.index()
    # No variation moves a centre of mass, and the plant's own Context is not in every diagram.
    force.p_BoBq_B = body.default_com()
    force.F_Bq_W = SpatialForce(np.zeros(3), np.array(push.force_n, dtype=float))
    loop.GetInputPort("applied_spatial_force").FixValue(context, [force])


def end_push(loop: ClosedLoop, context: Context) -> None:
    """From now on nothing pushes the loop's robot.

    Args:
        loop: A closed loop with the input port ``applied_spatial_force``.
        context: Its root Context.
    """
    loop.GetInputPort("applied_spatial_force").FixValue(context, [])
