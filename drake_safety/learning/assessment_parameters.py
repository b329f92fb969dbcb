"""What a safety assessment is learned and adapted with: the schema of a scenario's `assessment`."""

from dataclasses import dataclass, field

from drake_safety.learning.distance import BACKENDS

MODES = ("paper", "sharpened")


@dataclass(kw_only=True)
class AdaptationParameters:
    """How feedback of the actual robot changes an assessment.

    The first five default to the paper's Table I, update_interval to its text.

    Attributes:
        gate: sigma_thre, standard deviation of the discrepancy up to which it is believed (paper).
        least_uncertainty: mu_min of nominal beliefs where nothing differs (paper).
        decay_rate: alpha, how fast feedback beliefs lose their uncertainty (paper).
        first_uncertainty: beta, uncertainty of a feedback belief from one sample (paper).
        update_interval: k_u, feedback sets from one update to the next.
        counts_per_cell: Whether n_f in a feedback belief's uncertainty is the number of samples in
            its own cell, or literally the number of all feedback sets (paper).
        offset_std: Standard deviation of the prior of what changes in the base logit's
            offset (sharpened).
        slope_std: The same of either of its slopes (sharpened).
        hidden_std: The same of what the maps' last hidden layer adds to it, where its activations
            are as far from their mean as they are in feedback (sharpened).
    """

    gate: float = 0.3
    least_uncertainty: float = 0.1
    decay_rate: float = 0.4
    first_uncertainty: float = 0.3
    update_interval: int = 40
    counts_per_cell: bool = True
    offset_std: float = 2.0
    slope_std: float = 0.5
    hidden_std: float = 1.0

    def __post_init__(self) -> None:
        for name in ("least_uncertainty", "first_uncertainty"):
            self._expect(name, 0.0 <= getattr(self, name) <= 1.0, "a value in [0, 1]")
        for name in ("offset_std", "slope_std", "hidden_std"):
            self._expect(name, getattr(self, name) > 0.0, "> 0")
        for name in ("gate", "decay_rate"):
            self._expect(name, getattr(self, name) >= 0.0, ">= 0")
        self._expect("update_interval", self.update_interval >= 1, ">= 1")

    def _expect(self, name: str, holds: bool, expected: str) -> None:
        if not holds:
            raise ValueError(
                f"AdaptationParameters: {name} is {getattr(self, name)}, expected {expected}"
            )


@dataclass(kw_only=True)
class AssessmentParameters:
    """What a safety assessment is trained with.

    discount, horizon, score_weight, initial_uncertainty and min_count default to the paper's
    Table I, resolution and cell_length to its text; the other defaults are our own.

    The paper's mode is fixed beyond Table I: one plain map with two layers of 128, trained on
    segments that do not overlap. What is marked "sharpened" has no meaning there.

    Attributes:
        mode: "sharpened" or "paper".
        discount: gamma of the unsafety score.
        horizon: H [steps].
        score_weight: delta, the weight of score differences in Omega.
        initial_uncertainty: mu_ini of nominal beliefs.
        min_count: k_min, beliefs below which a cell stays empty.
        resolution: Cells a side of the grid.
        cell_length: Side of a cell.
        distance_backend: What computes dynamic time warping: "dtaidistance", or "tslearn", which
            takes some twenty times as long and gives the same values.
        perplexity: Effective number of neighbours in t-SNE.
        seed: Seeds t-SNE and the maps.
        learning_rate: Peak learning rate of the maps.
        batch_size: Segments a training step.
        epochs: Passes over the segments (sharpened; the paper's mode makes 40 over its fewer ones).
        ensemble_size: Number of maps K (sharpened).
        held_out: Share of the episodes that maps are tried on, before others of their kind learn
            from all: what they say of these makes Gamma a probability (sharpened).
        hidden_sizes: Widths of a map's layers (sharpened).
        dropout: Share of activations dropped in training (sharpened).
        target_weight: Weight of the distance to t-SNE's points (sharpened). A light one lets safety
            decide where neighbours in t-SNE part.
        safety_weight: Weight of the safety head's loss (sharpened).
        margin_weight: Weight of the margin head's loss (sharpened).
        margin_unit: Margin that counts as one in the Huber loss [m] (sharpened).
        margin_range: Range margins are clipped to, [lowest, highest] [m] (sharpened).
        raw_input_scale: Spread of state and preview as a map sees them, beside features of spread
            one (sharpened). Where the features say nearly all, a small one keeps the maps from
            learning the rest by heart.
        feature_unit: Features enter a second time as asinh(f / feature_unit), which spreads out
            what lies near a margin's zero [unit of the features]; 0 leaves that out (sharpened).
        shortest_segment: Steps that a safe episode's segment has at least; 0 stands for the whole
            horizon (sharpened). For episodes that end at rest.
        first_row_weight: Weight of the segment an episode starts with, relative to the others: they
            are few, and verdicts at planning time rest on them (sharpened).
        adaptation: How feedback of the actual robot changes it.
    """

    mode: str = "sharpened"
    discount: float = 0.99
    horizon: int = 10
    score_weight: float = 0.01
    initial_uncertainty: float = 0.3
    min_count: int = 5
    resolution: int = 14
    cell_length: float = 10.0
    distance_backend: str = "dtaidistance"
    perplexity: float = 30.0
    seed: int = 0
    learning_rate: float = 2e-3
    batch_size: int = 512
    epochs: int = 18
    ensemble_size: int = 3
    held_out: float = 0.3
    hidden_sizes: list[int] = field(default_factory=lambda: [128, 128])
    dropout: float = 0.2
    target_weight: float = 0.1
    safety_weight: float = 5.0
    margin_weight: float = 1.0
    margin_unit: float = 0.02
    margin_range: list[float] = field(default_factory=lambda: [-0.03, 0.10])
    first_row_weight: float = 6.0
    shortest_segment: int = 0
    raw_input_scale: float = 1.0
    feature_unit: float = 0.0
    adaptation: AdaptationParameters = field(default_factory=AdaptationParameters)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(
                f"AssessmentParameters: unknown mode '{self.mode}'; the modes are {list(MODES)}"
            )
        self._expect(
            "distance_backend", self.distance_backend in BACKENDS, f"one of {list(BACKENDS)}"
        )
        for name in ("discount", "initial_uncertainty"):
            self._expect(name, 0.0 <= getattr(self, name) <= 1.0, "a value in [0, 1]")
        for name in (
            "score_weight",
            "target_weight",
            "safety_weight",
            "margin_weight",
            "feature_unit",
        ):
            self._expect(name, getattr(self, name) >= 0.0, ">= 0")
        for name in ("horizon", "min_count", "resolution", "batch_size", "epochs", "ensemble_size"):
            self._expect(name, getattr(self, name) >= 1, ">= 1")
        for name in (
            "cell_length",
            "learning_rate",
            "margin_unit",
            "first_row_weight",
            "raw_input_scale",
        ):
            self._expect(name, getattr(self, name) > 0.0, "> 0")
        self._expect(
            "shortest_segment", 0 <= self.shortest_segment <= self.horizon, "a value in 0..horizon"
        )
        self._expect("perplexity", self.perplexity >= 1.0, ">= 1")
        for name in ("dropout", "held_out"):
            self._expect(name, 0.0 <= getattr(self, name) < 1.0, "a value in [0, 1)")
        self._expect(
            "hidden_sizes",
            bool(self.hidden_sizes) and all(size >= 1 for size in self.hidden_sizes),
            "one width >= 1 a layer",
        )
        self._expect(
            "margin_range",
            len(self.margin_range) == 2 and self.margin_range[0] < self.margin_range[1],
            "[lowest, highest]",
        )

    def _expect(self, name: str, holds: bool, expected: str) -> None:
        if not holds:
            raise ValueError(
                f"AssessmentParameters: {name} is {getattr(self, name)}, expected {expected}"
            )

    @property
    def is_sharpened(self) -> bool:
        """Whether the mode is "sharpened"."""
        return self.mode == "sharpened"

    @property
    def num_members(self) -> int:
        """K, the number of maps: one in the paper's mode."""
        return self.ensemble_size if self.is_sharpened else 1

    @property
    def stride(self) -> int:
        """Rows between the starts of two segments: one, or H in the paper's mode."""
        return 1 if self.is_sharpened else self.horizon

    @property
    def shortest(self) -> int:
        """Steps that a safe episode's segment has at least."""
        return (self.shortest_segment or self.horizon) if self.is_sharpened else self.horizon
