"""The schema of a scenario's `assessment`: parameters of training and adaptation."""

from dataclasses import asdict, field
from typing import Annotated, Literal

from pydantic import Field

from drake_safety.files.schema import (
    Count,
    Interval,
    NotNegative,
    Positive,
    Share,
    ShareBelowOne,
    load_typed,
    schema,
)
from drake_safety.learning.distance import Backend

Widths = Annotated[list[Annotated[int, Field(ge=1, le=10_000)]], Field(min_length=1)]
MOST_SAMPLES = 10_000  # Largest horizon, for which names and previews are made.


@schema(kw_only=True)
class AdaptationParameters:
    """Parameters of the adaptation to feedback, with the defaults of the paper's Table I and text.

    All but the last one are the paper's mode's.
    """

    gate: NotNegative = 0.3  # sigma_thre, above which a standard deviation refuses a discrepancy.
    least_uncertainty: Share = 0.1  # mu_min of nominal beliefs without discrepancy.
    decay_rate: NotNegative = 0.4  # alpha, at which feedback beliefs lose uncertainty.
    first_uncertainty: Share = 0.3  # beta, of a feedback belief from one sample.
    update_interval: Count = 40  # k_u, pairs of episodes between two updates.


@schema(kw_only=True)
class PaperReading:
    """Choices that the paper leaves open, about its segments, its input x and its map Psi.

    The defaults have the highest held-out accuracy on the robots, see docs/paper.md.
    """

    # Samples between the starts of segments; 0 means H, segments that do not overlap.
    stride: Annotated[int, Field(ge=0)] = 1
    standardized: bool = False  # Whether columns of x are scaled to mean 0 and deviation 1.
    hidden_sizes: Widths = field(default_factory=lambda: [128, 128])
    dropout: ShareBelowOne = 0.3
    epochs: Count = 60


@schema(kw_only=True)
class AssessmentParameters:
    """Parameters of a safety assessment, with the defaults of the paper's Table I and text.

    The paper's mode has one plain map, described by `paper`; parameters from `epochs` to
    `feature_unit` are the sharpened mode's.

    Example: ``parameters = AssessmentParameters(horizon=20, ensemble_size=1)``
    """

    mode: Literal["sharpened", "paper"] = "sharpened"
    discount: Share = 0.99  # gamma of the unsafety score.
    horizon: Annotated[int, Field(ge=1, le=MOST_SAMPLES)] = 10  # H, samples of preview and segment.
    preview_stride: Count = 1  # Rows of an episode between two of them.
    score_weight: NotNegative = 0.01  # delta, of score differences in Omega.
    initial_uncertainty: Share = 0.3  # mu_ini of nominal beliefs.
    min_count: Count = 5  # k_min, beliefs below which a cell stays empty.
    resolution: Annotated[int, Field(ge=1, le=1000)] = 14  # Cells per side of the grid.
    cell_length: Positive = 10.0
    # tslearn gives the same values in about twenty times the time.
    distance_backend: Backend = "dtaidistance"
    perplexity: Annotated[float, Field(ge=1)] = 30.0  # Effective number of neighbours in t-SNE.
    # Segments among which each of t-SNE's neighbours is sought, by the smallest bounds of
    # Omega; 0 for all segments, with the cost N².
    candidates_per_neighbour: Annotated[int, Field(ge=0)] = 2
    # Factor of t-SNE's attraction after its early phase; 1 is plain t-SNE.
    exaggeration: Annotated[float, Field(ge=1)] = 4.0
    # Share of episodes in which an input may exceed a limit of novelty.
    novelty_rate: Annotated[float, Field(gt=0, lt=1)] = 0.01
    # Largest distance of a known input's column from the centre of its range in training [half
    # widths]; larger for a robot that sags more than training's rows do.
    novelty_range: Annotated[float, Field(ge=1)] = 1.25
    seed: int = 0  # Seed of t-SNE and of the maps.
    learning_rate: Positive = 2e-3  # At its peak.
    batch_size: Count = 512
    epochs: Count = 18
    ensemble_size: Annotated[int, Field(ge=1, le=100)] = 3  # K maps.
    # Share of episodes on which the base logit is fitted; the final maps are trained on all.
    held_out: ShareBelowOne = 0.3
    hidden_sizes: Widths = field(default_factory=lambda: [128, 128])
    dropout: ShareBelowOne = 0.2
    margin_unit: Positive = 0.02  # Margin that counts as one in the Huber loss [m].
    # Range to which margins are clipped, [lowest, highest] [m].
    margin_range: Interval = field(default_factory=lambda: [-0.03, 0.10])
    first_row_weight: Positive = 6.0  # Weight of an episode's first segment, for verdicts on plans.
    # Least samples of a safe episode's segment, if episodes end at rest; 0 means H.
    shortest_segment: Annotated[int, Field(ge=0)] = 0
    # Spread of state and preview as inputs, where features have spread one; a small one prevents
    # overfitting to them if the features suffice.
    raw_input_scale: Positive = 1.0
    # Features enter a second time as asinh(f / feature_unit), which resolves margins near zero
    # [unit of the features]; 0 disables it.
    feature_unit: NotNegative = 0.0
    paper: PaperReading = field(default_factory=PaperReading)
    adaptation: AdaptationParameters = field(default_factory=AdaptationParameters)

    def __post_init__(self) -> None:
        if self.shortest_segment > self.horizon:
            raise ValueError(f"shortest_segment {self.shortest_segment} exceeds the horizon")

    def check(self) -> None:
        """Checks all values, which may have been set since the construction."""
        load_typed(type(self), asdict(self), type(self).__name__)
