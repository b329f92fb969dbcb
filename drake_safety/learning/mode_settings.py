"""The settings that the stages of learning read, resolved by the mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drake_safety.learning.assessment_parameters import AssessmentParameters


@dataclass(frozen=True, kw_only=True)
class ModeSettings:
    """The settings that differ between the modes.

    The others are those of `AssessmentParameters` and `PaperReading` by the same names.

    Attributes:
        stride: Rows between the starts of segments.
        shortest: Least number of samples of a safe episode's segment.
        target_stride: Rows between the starts of an episode's segments that t-SNE embeds.
        uses_features: Whether x has the features.
        uses_true_state: Whether the states of the nominal plant in x are without noise.
        velocities: Whether x has the velocities in the state.
        num_maps: K.
        is_regression: Whether a map reproduces t-SNE's points and no more. Held-out episodes then
            stop its training, and its inputs and outputs keep their range.
        trees: Whether trees are learned beside the maps.
        interpolates: Whether beliefs are interpolated between cell centres.
    """

    stride: int
    shortest: int
    target_stride: int
    uses_features: bool
    uses_true_state: bool
    velocities: bool = True
    num_maps: int
    is_regression: bool
    hidden_sizes: Sequence[int]
    dropout: float
    epochs: int
    held_out: float
    weight_decay: float = 1e-4
    standardized: bool = True
    loss: str = "squared"
    target_weight: float = 1.0
    safety_weight: float = 0.0
    margin_weight: float = 0.0
    first_row_weight: float = 1.0
    raw_input_scale: float = 1.0
    trees: bool = False
    interpolates: bool


def mode_settings(parameters: AssessmentParameters) -> ModeSettings:
    """Resolves parameters by their mode."""
    is_paper, horizon = parameters.mode == "paper", parameters.horizon
    source = parameters.paper if is_paper else parameters
    names = ["hidden_sizes", "dropout", "epochs", "held_out"]
    if is_paper:
        names += ["velocities", "weight_decay", "standardized", "loss"]
        stride, shortest, target_stride = (parameters.paper.stride or horizon), horizon, 1
        stride *= parameters.preview_stride
    else:
        names += ["target_weight", "safety_weight", "margin_weight"]
        names += ["first_row_weight", "raw_input_scale", "trees"]
        stride, shortest = 1, parameters.shortest_segment or horizon
        target_stride = max(horizon // 2, 1) * parameters.preview_stride
    return ModeSettings(
        stride=stride,
        shortest=shortest,
        target_stride=target_stride,
        uses_features=not is_paper,
        uses_true_state=is_paper,
        num_maps=1 if is_paper else parameters.ensemble_size,
        is_regression=is_paper,
        interpolates=not is_paper,
        **{name: getattr(source, name) for name in names},
    )
