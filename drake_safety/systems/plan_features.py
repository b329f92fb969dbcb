"""PlanFeatures: the safe set's features of state and plan, as inputs of the assessor."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_safety.learning.segments import floats
from drake_safety.systems.safety_monitor import FeaturedSafeSet


class PlanFeatures(LeafSystem):
    """Evaluates the safe set's features on the measured state and the desired preview.

    .. pydrake_system::

        name: PlanFeatures
        input_ports:
        - plant_state: n_q + n_v
        - desired_preview: M n_z
        output_ports:
        - features: n_f
    """

    def __init__(
        self,
        safe_set: FeaturedSafeSet,
        num_positions: int,
        num_velocities: int,
        *,
        horizon: int,
    ):
        super().__init__()
        self._safe_set = safe_set
        self._n_q = num_positions
        self.feature_names = list(safe_set.feature_names)
        self._state_port = self.DeclareVectorInputPort(
            "plant_state", num_positions + num_velocities
        )
        self._preview_port = self.DeclareVectorInputPort("desired_preview", 3 * horizon)
        self.DeclareVectorOutputPort(
            "features", BasicVector(len(self.feature_names)), self._calc_features
        )

    def _calc_features(self, context: Context, output: BasicVector) -> None:
        q, v = np.split(self._state_port.Eval(context), [self._n_q])
        preview = self._preview_port.Eval(context).reshape(-1, 3)
        output.SetFromVector(floats(self._safe_set.features(q, v, preview)))
