"""The settings that the stages of learning read, resolved by the mode."""

from collections.abc import Sequence
from dataclasses import dataclass

from drake_safety.learning.assessment_parameters import AssessmentParameters


@dataclass(frozen=True, kw_only=True)
class ModeSettings:
    """The settings that differ between the modes; most are explained by the parameters.

    In the paper's mode x has no features, nominal states are without noise, a map reproduces
    t-SNE's points and no more, and beliefs are not interpolated.
    """

    is_paper: bool
    stride: int  # Rows between the starts of segments.
    shortest: int  # Least number of samples of a safe episode's segment.
    target_stride: int  # Rows between the starts of an episode's segments that t-SNE embeds.
    num_maps: int
    hidden_sizes: Sequence[int]
    dropout: float
    epochs: int
    weight_decay: float
    standardized: bool = True
    held_out: float = 0.0
    first_row_weight: float = 1.0
    raw_input_scale: float = 1.0


def mode_settings(parameters: AssessmentParameters) -> ModeSettings:
    """Resolves parameters by their mode."""
    horizon = parameters.horizon
    if parameters.mode == "paper":
        own = dict(vars(parameters.paper))
        stride = (own.pop("stride") or horizon) * parameters.preview_stride
        return ModeSettings(
            is_paper=True,
            stride=stride,
            shortest=horizon,
            target_stride=1,
            num_maps=1,
            weight_decay=0.01,
            **own,
        )
    return ModeSettings(
        is_paper=False,
        stride=1,
        shortest=parameters.shortest_segment or horizon,
        target_stride=max(horizon // 2, 1) * parameters.preview_stride,
        num_maps=parameters.ensemble_size,
        hidden_sizes=parameters.hidden_sizes,
        dropout=parameters.dropout,
        epochs=parameters.epochs,
        weight_decay=1e-4,
        held_out=parameters.held_out,
        first_row_weight=parameters.first_row_weight,
        raw_input_scale=parameters.raw_input_scale,
    )
