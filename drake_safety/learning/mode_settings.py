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
        is_paper: Whether the mode is the paper's: x has no features, nominal states are without
            noise, a map reproduces t-SNE's points and no more, and beliefs are not interpolated.
        stride: Rows between the starts of segments.
        shortest: Least number of samples of a safe episode's segment.
        target_stride: Rows between the starts of an episode's segments that t-SNE embeds.
        num_maps: K.
    """

    is_paper: bool
    stride: int
    shortest: int
    target_stride: int
    num_maps: int
    hidden_sizes: Sequence[int]
    dropout: float
    epochs: int
    weight_decay: float = 1e-4
    standardized: bool = True
    held_out: float = 0.0
    target_weight: float = 1.0
    safety_weight: float = 0.0
    margin_weight: float = 0.0
    first_row_weight: float = 1.0
    raw_input_scale: float = 1.0
    trees: bool = False


def mode_settings(parameters: AssessmentParameters) -> ModeSettings:
    """Resolves parameters by their mode."""
    horizon = parameters.horizon
    if parameters.mode == "paper":
        stride = (parameters.paper.stride or horizon) * parameters.preview_stride
        own = vars(parameters.paper) | {"stride": stride}
        return ModeSettings(is_paper=True, shortest=horizon, target_stride=1, num_maps=1, **own)
    names = ["hidden_sizes", "dropout", "epochs", "held_out", "target_weight", "safety_weight"]
    names += ["margin_weight", "first_row_weight", "raw_input_scale", "trees"]
    return ModeSettings(
        is_paper=False,
        stride=1,
        shortest=parameters.shortest_segment or horizon,
        target_stride=max(horizon // 2, 1) * parameters.preview_stride,
        num_maps=parameters.ensemble_size,
        **{name: getattr(parameters, name) for name in names},
    )
