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
    """Parameters of the adaptation to feedback from the actual robot.

    The first four default to the paper's Table I, update_interval to its text.

    Attributes:
        gate: sigma_thre, largest standard deviation at which the discrepancy is used (paper).
        least_uncertainty: mu_min of nominal beliefs without discrepancy (paper).
        decay_rate: alpha, rate at which feedback beliefs lose uncertainty (paper).
        first_uncertainty: beta, uncertainty of a feedback belief from one sample (paper).
        update_interval: k_u, pairs of episodes between two updates.
    """

    gate: NotNegative = 0.3
    least_uncertainty: Share = 0.1
    decay_rate: NotNegative = 0.4
    first_uncertainty: Share = 0.3
    update_interval: Count = 40


@schema(kw_only=True)
class PaperReading:
    """What the paper leaves open about its segments, its input x and its map Psi.

    The defaults have the highest held-out accuracy on the robots, see docs/paper.md.

    Attributes:
        stride: Samples between the starts of segments; 0 means H, segments that do not overlap.
        standardized: Whether every column of x is scaled to mean 0 and standard deviation 1.
        hidden_sizes: Widths of the layers of Psi, "a deep neural network".
        epochs: Passes over the segments.
    """

    stride: Annotated[int, Field(ge=0)] = 1
    standardized: bool = False
    hidden_sizes: Widths = field(default_factory=lambda: [128, 128])
    dropout: ShareBelowOne = 0.3
    epochs: Count = 60


@schema(kw_only=True)
class AssessmentParameters:
    """Parameters of a safety assessment.

    discount, horizon, score_weight, initial_uncertainty and min_count default to the paper's
    Table I, resolution and cell_length to its text. The paper's mode has one plain map, described
    by `paper`; it ignores the attributes marked "sharpened".

    Attributes:
        mode: "sharpened" or "paper".
        discount: gamma of the unsafety score.
        horizon: H, samples of the preview and of a segment.
        preview_stride: Rows of an episode between two of them.
        score_weight: delta, the weight of score differences in Omega.
        initial_uncertainty: mu_ini of nominal beliefs.
        min_count: k_min, beliefs below which a cell stays empty.
        resolution: Number of cells per side of the grid.
        cell_length: Side of a cell.
        distance_backend: "dtaidistance", or "tslearn", with the same values in twenty times the
            time.
        perplexity: Effective number of neighbours in t-SNE.
        candidates_per_neighbour: Segments among which each of t-SNE's neighbours is sought, those
            with the smallest bounds of Omega; 0 for all segments, with the cost N².
        exaggeration: Factor of t-SNE's attraction after its early phase; 1 is plain t-SNE.
        novelty_rate: Share of episodes in which an input may exceed a limit of novelty.
        novelty_range: Largest distance of a known input's column from the centre of its range in
            training [half widths]; larger for a robot that sags more than training's rows do.
        seed: Seed of t-SNE and of the maps.
        learning_rate: Peak learning rate of the maps.
        batch_size: Segments per training step.
        epochs: Passes over the segments (sharpened).
        ensemble_size: Number of maps K (sharpened).
        held_out: Share of episodes on which the base logit is fitted; the final maps are trained
            on all episodes (sharpened).
        hidden_sizes: Widths of a map's layers (sharpened).
        dropout: Dropout rate (sharpened).
        margin_unit: Margin that counts as one in the Huber loss [m] (sharpened).
        margin_range: Range margins are clipped to, [lowest, highest] [m] (sharpened).
        first_row_weight: Weight of an episode's first segment, for verdicts on plans (sharpened).
        shortest_segment: Least number of samples of a safe episode's segment, for episodes that end
            at rest; 0 means the whole horizon (sharpened).
        raw_input_scale: Spread of state and preview as inputs, where features have spread one; a
            small one prevents overfitting to them if the features suffice (sharpened).
        feature_unit: Features enter a second time as asinh(f / feature_unit), which resolves
            margins near zero [unit of the features]; 0 disables it (sharpened).
    """

    mode: Literal["sharpened", "paper"] = "sharpened"
    discount: Share = 0.99
    horizon: Annotated[int, Field(ge=1, le=MOST_SAMPLES)] = 10
    preview_stride: Count = 1
    score_weight: NotNegative = 0.01
    initial_uncertainty: Share = 0.3
    min_count: Count = 5
    resolution: Annotated[int, Field(ge=1, le=1000)] = 14
    cell_length: Positive = 10.0
    distance_backend: Backend = "dtaidistance"
    perplexity: Annotated[float, Field(ge=1)] = 30.0
    candidates_per_neighbour: Annotated[int, Field(ge=0)] = 2
    exaggeration: Annotated[float, Field(ge=1)] = 4.0
    novelty_rate: Annotated[float, Field(gt=0, lt=1)] = 0.01
    novelty_range: Annotated[float, Field(ge=1)] = 1.25
    seed: int = 0
    learning_rate: Positive = 2e-3
    batch_size: Count = 512
    epochs: Count = 18
    ensemble_size: Annotated[int, Field(ge=1, le=100)] = 3
    held_out: ShareBelowOne = 0.3
    hidden_sizes: Widths = field(default_factory=lambda: [128, 128])
    dropout: ShareBelowOne = 0.2
    margin_unit: Positive = 0.02
    margin_range: Interval = field(default_factory=lambda: [-0.03, 0.10])
    first_row_weight: Positive = 6.0
    shortest_segment: Annotated[int, Field(ge=0)] = 0
    raw_input_scale: Positive = 1.0
    feature_unit: NotNegative = 0.0
    paper: PaperReading = field(default_factory=PaperReading)
    adaptation: AdaptationParameters = field(default_factory=AdaptationParameters)

    def __post_init__(self) -> None:
        if self.shortest_segment > self.horizon:
            raise ValueError(f"shortest_segment {self.shortest_segment} exceeds the horizon")

    def check(self) -> None:
        """Checks all values, which may have been set since the construction."""
        load_typed(type(self), asdict(self), type(self).__name__)
