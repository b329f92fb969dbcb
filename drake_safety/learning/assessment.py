"""The safety assessment function Gamma: how likely the closed loop stays safe from here on."""

import json
import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.embedding import (
    INPUT_LIMIT,
    Embedding,
    MapData,
    MapSettings,
    stack_members,
    train_map,
    tsne,
)
from drake_safety.learning.grid import OUTSIDE, Grid
from drake_safety.learning.segments import Episodes, EpisodesInfo, Segments, split

MODES = ("paper", "sharpened")
SCHEMA = "drake_safety.assessment"
SCHEMA_VERSION = 1
_INSIDE_SHARE = 0.995
"""Share of the inputs that a map may not send beyond the extent of t-SNE's points."""
_logger = logging.getLogger("drake_safety")


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
        perplexity: Effective number of neighbours in t-SNE.
        seed: Seeds t-SNE and the maps.
        learning_rate: Peak learning rate of the maps.
        batch_size: Segments a training step.
        epochs: Passes over the segments (sharpened; the paper's mode makes 40 over its fewer ones).
        ensemble_size: Number of maps K (sharpened).
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
    """

    mode: str = "sharpened"
    discount: float = 0.99
    horizon: int = 10
    score_weight: float = 0.01
    initial_uncertainty: float = 0.3
    min_count: int = 5
    resolution: int = 14
    cell_length: float = 10.0
    perplexity: float = 30.0
    seed: int = 0
    learning_rate: float = 2e-3
    batch_size: int = 512
    epochs: int = 18
    ensemble_size: int = 3
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

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(
                f"AssessmentParameters: unknown mode '{self.mode}'; the modes are {list(MODES)}"
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
        self._expect("dropout", 0.0 <= self.dropout < 1.0, "a value in [0, 1)")
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


@dataclass(kw_only=True, eq=False)
class Assessments:
    """What an assessment says of N inputs.

    Attributes:
        safety_probability: Gamma = b_safe, (N,). At most 1 - mu: not a calibrated probability.
        normalized: b_safe / (1 - mu), the safe share of what is known, (N,); 0 where nothing is.
        belief: (b_safe, b_unsafe, mu), (N, 3); empty for inputs that are not finite.
        embedding: y by the first map, (N, 2); NaN for inputs that are not finite.
        cause_probability: b_unsafe split by the constraint that will be violated, (N, n_c).
        predicted_margins: Smallest margin of each constraint until the episode's end [unit of the
            margins], (N, n_c); NaN for inputs that are not finite, without a margin head, and
            always in the paper's mode.
        unsafe_logit: Mean logit of the maps' safety heads, (N,); NaN where there is none.
    """

    safety_probability: np.ndarray
    normalized: np.ndarray
    belief: np.ndarray
    embedding: np.ndarray
    cause_probability: np.ndarray
    predicted_margins: np.ndarray
    unsafe_logit: np.ndarray


@dataclass(kw_only=True, eq=False, slots=True)
class Assessment:
    """What an assessment says of one input; the fields of `Assessments` without the axis N."""

    safety_probability: float
    normalized: float
    belief: np.ndarray
    cause_probability: np.ndarray
    embedding: np.ndarray
    predicted_margins: np.ndarray


class SafetyAssessment:
    """Gamma: from the state and the desired outputs ahead to a belief about safety.

    `fit` learns it from nominal episodes. Learned attributes end in an underscore:

    - `info_`: the `EpisodesInfo` of the training episodes.
    - `grid_`: the `Grid` of the embedding space.
    - `embedding_`: the maps Psi, an `Embedding`, immutable.
    - `beliefs_`: the belief of every map's cells, (K, R*R, 3 + n_c); it may be replaced, and every
      prediction takes other beliefs as an argument.
    - `training_points_`, `training_score_`, `training_cause_`: Psi(x), lambda and the cause of the
      segments in the cells, (K, N, 2), (N,), (N,), which adaptation starts from.
    - `calibrations_`: the `Calibration` by its kind, of these maps and `beliefs_`; empty until it
      is set.

    Departure ("sharpened" only): x gains the safe set's own signed margins along the plan
    (`features`), the maps learn safety and future margins beside t-SNE's points from every start
    row, Gamma interpolates between cell centres instead of jumping at cell edges, and it is the
    mean over a few maps, each with its own grid. Read literally the method is weak on the robots;
    the "paper" mode is that reading, to compare with.
    """

    def __init__(self, parameters: AssessmentParameters | None = None):
        self.parameters = AssessmentParameters() if parameters is None else parameters

    @property
    def uses_features(self) -> bool:
        """Whether x has the features: in the sharpened mode."""
        return self.parameters.is_sharpened

    def fit(
        self, episodes: Episodes, progress: Callable[[str, float], None] | None = None
    ) -> "SafetyAssessment":
        """Learns embedding and beliefs from nominal episodes.

        Args:
            episodes: Nominal episodes whose horizon is the parameters' own.
            progress: Called with a stage ("distances", "t-SNE", "training", "beliefs") and the
                fraction of it that is done.

        Returns:
            Itself.

        Raises:
            ValueError: The horizons differ, or the episodes give too few segments.
        """
        parameters = self.parameters
        info = episodes.info
        if info.horizon != parameters.horizon:
            raise ValueError(
                f"SafetyAssessment: horizon is {parameters.horizon}, but the episodes of "
                f"'{info.scenario}' look {info.horizon} steps ahead"
            )

        def stage(name: str) -> Callable[[float], None] | None:
            return None if progress is None else lambda fraction: progress(name, fraction)

        horizon = parameters.horizon
        stride = 1 if parameters.is_sharpened else horizon
        segments = split(
            episodes,
            stride=stride,
            discount=parameters.discount,
            shortest=(parameters.shortest_segment or None) if parameters.is_sharpened else None,
        )
        every = max(horizon // 2, 1) if parameters.is_sharpened else 1
        first = np.array([episode.first_step for episode in episodes])[segments.episode]
        has_target = (segments.start_row - first) % every == 0
        targeted = segments.take(has_target)
        num_neighbours = int(3 * parameters.perplexity)
        if len(targeted) <= num_neighbours:
            raise ValueError(
                f"SafetyAssessment: perplexity {parameters.perplexity} needs more than "
                f"{num_neighbours} segments, the {len(episodes)} episodes give {len(targeted)}"
            )
        _logger.info(
            "training on %d segments of %d episodes (%d unsafe, %d diverged), %d of them in t-SNE",
            len(segments),
            len(episodes),
            episodes.num_unsafe,
            episodes.num_diverged,
            len(targeted),
        )
        graph = neighbour_graph(
            targeted.error,
            targeted.length,
            targeted.score,
            score_weight=parameters.score_weight,
            num_neighbours=num_neighbours,
            progress=stage("distances"),
        )
        self.grid_ = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
        points = tsne(
            graph,
            perplexity=parameters.perplexity,
            seed=parameters.seed,
            progress=stage("t-SNE"),
        )
        x = self._inputs(
            segments.state if parameters.is_sharpened else segments.true_state,
            segments.desired_preview,
            segments.features if parameters.is_sharpened else None,
        )
        data = MapData(
            x=x,
            has_target=has_target,
            target=self.grid_.scale(points),
            is_unsafe=segments.is_unsafe,
            margins=segments.future_margins,
            sample_weight=self._sample_weight(segments),
            input_scale=self._input_scale(x.shape[1], segments.features.shape[1]),
        )
        self.info_ = info
        self.calibrations_: dict[str, Calibration] = {}
        self.embedding_ = self._train(data, stage("training"))
        self._fill_cells(x, segments)
        if progress is not None:
            progress("beliefs", 1.0)
        return self

    def _sample_weight(self, segments: Segments) -> np.ndarray:
        weight = np.ones(len(segments))
        if self.parameters.is_sharpened:
            weight[segments.is_first] = self.parameters.first_row_weight
        return weight / weight.mean()

    def _input_scale(self, num_inputs: int, num_features: int) -> np.ndarray:
        scale = np.ones(num_inputs)
        if self.parameters.is_sharpened:
            num_copies = 2 if self.parameters.feature_unit else 1
            scale[: num_inputs - num_copies * num_features] = self.parameters.raw_input_scale
        return scale

    def _train(self, data: MapData, progress: Callable[[float], None] | None) -> Embedding:
        parameters = self.parameters
        is_sharpened = parameters.is_sharpened
        settings = MapSettings(
            hidden_sizes=tuple(parameters.hidden_sizes) if is_sharpened else (128, 128),
            dropout=parameters.dropout if is_sharpened else 0.0,
            epochs=parameters.epochs if is_sharpened else 40,
            batch_size=parameters.batch_size,
            learning_rate=parameters.learning_rate,
            target_weight=parameters.target_weight if is_sharpened else 1.0,
            safety_weight=parameters.safety_weight if is_sharpened else 0.0,
            margin_weight=parameters.margin_weight if is_sharpened else 0.0,
            margin_unit=parameters.margin_unit,
            margin_range=(parameters.margin_range[0], parameters.margin_range[1]),
        )
        num_members = parameters.num_members
        members = []
        for member in range(num_members):

            def report(fraction: float, member: int = member) -> None:
                if progress is not None:
                    progress((member + fraction) / num_members)

            seed = int(
                np.random.SeedSequence(parameters.seed, spawn_key=(member,)).generate_state(1)[0]
            )
            members.append(train_map(data, settings, seed=seed, progress=report))
        num_margins = data.margins.shape[1] if settings.margin_weight > 0.0 else 0
        embedding = stack_members(members, num_margins=num_margins)
        return self._fill_grid(embedding, data) if is_sharpened else embedding

    @staticmethod
    def _fill_grid(embedding: Embedding, data: MapData) -> Embedding:
        """Scales the maps so that what they do with the inputs is as wide as t-SNE's points.

        Departure: a light weight on the distance to t-SNE's points leaves the maps' scale open;
        some inputs would fall off the grid, or all into few of its cells.
        """
        reach = np.abs(embedding.embed(data.x)).max(axis=2)
        extent = np.quantile(reach, _INSIDE_SHARE, axis=1)
        return embedding.scaled((np.abs(data.target).max() / extent).astype(np.float32))

    def _fill_cells(self, x: np.ndarray, segments: Segments) -> None:
        parameters = self.parameters
        num_causes = len(self.info_.constraint_names)
        self.training_points_ = self.embedding_.embed(x).astype(np.float32)
        self.training_score_ = segments.score
        self.training_cause_ = segments.cause
        masses = belief_masses.from_scores(
            segments.score, parameters.initial_uncertainty, segments.cause, num_causes
        )
        self.beliefs_ = np.stack(
            [
                belief_masses.fuse_cells(
                    masses,
                    # L(x): the cell of Psi(x), not of the point t-SNE gave the segment.
                    self.grid_.locate(points),
                    num_cells=self.grid_.num_cells,
                    min_count=parameters.min_count,
                )
                for points in self.training_points_
            ]
        )

    def _inputs(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """x, (N, n_x): [s; z*] in the paper's mode, [s; z*; features] in the sharpened one."""
        parts = [np.asarray(state, dtype=float), np.asarray(desired_preview, dtype=float)]
        if self.parameters.is_sharpened and features is not None:
            parts.append(np.asarray(features, dtype=float))
            if self.parameters.feature_unit:
                parts.append(np.arcsinh(parts[-1] / self.parameters.feature_unit))
        return np.concatenate(parts, axis=-1)

    def _check_fitted(self) -> None:
        if not hasattr(self, "beliefs_"):
            raise ValueError("SafetyAssessment: it has not been fitted or loaded yet")

    def _check_width(self, num_columns: int) -> None:
        if num_columns != self.embedding_.num_inputs:
            info = self.info_
            num_features = len(info.feature_names) if self.parameters.is_sharpened else 0
            raise ValueError(
                f"SafetyAssessment of '{info.scenario}': the input has {num_columns} columns, "
                f"expected {len(info.state_names)} of the state, "
                f"{info.horizon * len(info.output_names)} of the desired preview and "
                f"{num_features} features{' twice' if self.parameters.feature_unit else ''}"
            )

    def _beliefs(self, beliefs: np.ndarray | None) -> np.ndarray:
        if beliefs is None:
            return self.beliefs_
        if beliefs.shape != self.beliefs_.shape:
            raise ValueError(
                f"SafetyAssessment: beliefs have shape {beliefs.shape}, "
                f"expected {self.beliefs_.shape}"
            )
        return beliefs

    def predict(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        beliefs: np.ndarray | None = None,
    ) -> Assessments:
        """Assesses N inputs.

        Args:
            state: States as the assessor sees them, (N, n_s).
            desired_preview: Coming desired outputs, row-major in time, (N, H*n_z).
            features: Features, (N, n_f); the paper's mode has no use for them.
            beliefs: Beliefs of the cells instead of `beliefs_`, (K, R*R, 3 + n_c).

        Returns:
            The assessments. An input that is not finite is empty: Gamma is 0 there.

        Raises:
            ValueError: The widths or the beliefs' shape are wrong, or there is nothing learned yet.
        """
        self._check_fitted()
        beliefs = self._beliefs(beliefs)
        x = self._inputs(state, desired_preview, features)
        if x.ndim != 2:
            raise ValueError(f"SafetyAssessment: inputs have {x.ndim} axes, expected (N, columns)")
        self._check_width(x.shape[1])
        with np.errstate(over="ignore", invalid="ignore"):
            is_usable = np.einsum("ij,ij->i", x, x) < INPUT_LIMIT
        x = np.where(is_usable[:, None], x, np.nan)
        output = self.embedding_.evaluate(x)
        masses = np.zeros((len(x), beliefs.shape[2]))
        for member_beliefs, points in zip(beliefs, output.embedding, strict=True):
            masses += self._masses(member_beliefs, points)
        masses /= len(beliefs)
        num_causes = masses.shape[1] - 3
        safe = masses[:, belief_masses.SAFE]
        # As a sum, not as 1 - mu: rounding must not lift the share above one.
        known = safe + masses[:, belief_masses.UNSAFE]
        margins = np.full((len(x), num_causes), np.nan)
        if output.margins.shape[2]:
            margins = output.margins.mean(axis=0)
        return Assessments(
            # Gamma(x) = b_safe of the cell v = L(x)
            safety_probability=safe.copy(),
            normalized=np.divide(safe, known, out=np.zeros_like(safe), where=known > 0.0),
            belief=masses[:, :3].copy(),
            embedding=output.embedding[0],
            cause_probability=masses[:, 3:].copy(),
            predicted_margins=margins,
            unsafe_logit=output.unsafe_logit.mean(axis=0),
        )

    def _masses(self, beliefs: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Masses at points (N, 2) of one map, (N, 3 + n_c); empty outside the grid."""
        if self.parameters.is_sharpened:
            cells, weights = self.grid_.bilinear(points)
            masses = np.einsum("nk,nkc->nc", weights, beliefs[cells])
            is_outside = cells[:, 0] == OUTSIDE
        else:
            cells = self.grid_.locate(points)
            masses = beliefs[cells]
            is_outside = cells == OUTSIDE
        masses[is_outside] = belief_masses.empty((), beliefs.shape[1] - 3)
        return masses

    def predict_one(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        beliefs: np.ndarray | None = None,
    ) -> Assessment:
        """Assesses one input; the arguments are those of `predict` without the axis N."""
        self._check_fitted()
        row = self.predict_row(state, desired_preview, features, self._beliefs(beliefs))
        num_columns = self.beliefs_.shape[2]
        return Assessment(
            safety_probability=float(row[0]),
            normalized=float(row[1]),
            belief=row[2:5],
            cause_probability=row[5 : 2 + num_columns],
            embedding=row[2 + num_columns : 4 + num_columns],
            predicted_margins=row[4 + num_columns :],
        )

    def predict_row(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None,
        beliefs: np.ndarray,
    ) -> np.ndarray:
        """`predict_one` as one vector, for the online run: what it costs is most of the tick.

        Returns:
            The fields of `Assessment` one after the other, in their order, (7 + 2 n_c,).
        """
        is_sharpened = self.parameters.mode == "sharpened"
        parts: tuple[np.ndarray, ...] = (state, desired_preview)
        if is_sharpened and features is not None:
            parts = (state, desired_preview, features)
            if self.parameters.feature_unit:
                parts = (*parts, np.arcsinh(features / self.parameters.feature_unit))
        embedding, grid = self.embedding_, self.grid_
        width = sum(map(len, parts))
        if width != embedding.num_inputs:
            self._check_width(width)
        num_members, num_cells, num_columns = beliefs.shape
        row = np.empty(1 + 2 * num_columns)
        masses = row[2 : 2 + num_columns]
        output = embedding.evaluate_one(*parts)
        rows: list[int] = []
        if output is None:
            row[2 + num_columns :] = np.nan
        elif is_sharpened:
            weights: list[float] = []
            for member, (first, second) in enumerate(output[:, :2].tolist()):
                corners = grid.bilinear_one(first, second)
                if corners is not None:
                    start = member * num_cells
                    rows += [start + cell for cell in corners[0]]
                    weights += corners[1]
            if rows:
                np.dot(weights, beliefs.reshape(-1, num_columns).take(rows, axis=0), out=masses)
                masses /= num_members
                # A map that sends the input outside its grid knows nothing of it.
                masses[belief_masses.UNCERTAINTY] += 1.0 - len(rows) / (4 * num_members)
        else:
            cell = grid.locate_one(*output[0, :2].tolist())
            if cell != OUTSIDE:
                rows = [cell]
                masses[:] = beliefs[0, cell]
        if not rows:
            masses[:] = 0.0
            masses[belief_masses.UNCERTAINTY] = 1.0
        safe, unsafe = masses[:2].tolist()
        known = safe + unsafe
        row[0] = safe
        row[1] = safe / known if known > 0.0 else 0.0
        if output is not None:
            row[2 + num_columns : 4 + num_columns] = output[0, :2]
            row[4 + num_columns :] = np.nan
            if embedding.num_margins:
                np.add.reduce(output[:, 2:], out=row[4 + num_columns :])
                row[4 + num_columns :] /= num_members
        return row

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one safetensors file, first under a temporary name: it is whole or absent."""
        self._check_fitted()
        from safetensors.numpy import save

        tensors = {f"embedding.{name}": w for name, w in self.embedding_.weights.items()}
        tensors |= {
            "beliefs": self.beliefs_,
            "training_points": self.training_points_,
            "training_score": self.training_score_,
            "training_cause": self.training_cause_.astype(np.int64),
        }
        metadata = {
            "schema": SCHEMA,
            "schema_version": str(SCHEMA_VERSION),
            "parameters": json.dumps(asdict(self.parameters)),
            "info": json.dumps(asdict(self.info_)),
            "num_margins": str(self.embedding_.num_margins),
            "calibrations": json.dumps([one.to_json() for one in self.calibrations_.values()]),
        }
        content = save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata)
        path = Path(path)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).chmod(0o644)
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "SafetyAssessment":
        """Reads what `save` wrote.

        Raises:
            ValueError: The file is truncated, of another kind, or of another schema version.
        """
        metadata, tensors = _read(Path(path))
        if metadata.get("schema") != SCHEMA:
            raise ValueError(
                f"'{path}' is no safety assessment: its schema is '{metadata.get('schema')}', "
                f"expected '{SCHEMA}'"
            )
        if metadata.get("schema_version") != str(SCHEMA_VERSION):
            raise ValueError(
                f"'{path}' has the schema version {metadata.get('schema_version')}, this version "
                f"reads {SCHEMA_VERSION}: train the assessment again"
            )
        try:
            assessment = cls(AssessmentParameters(**json.loads(metadata["parameters"])))
            assessment.info_ = EpisodesInfo(**json.loads(metadata["info"]))
            # Files that were written before there were calibrations have none.
            stored = [Calibration(**one) for one in json.loads(metadata.get("calibrations", "[]"))]
            assessment.calibrations_ = {one.kind: one for one in stored}
            assessment._restore(tensors, int(metadata["num_margins"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"'{path}' is a damaged safety assessment: {error}") from error
        return assessment

    def _restore(self, tensors: dict[str, np.ndarray], num_margins: int) -> None:
        parameters, info = self.parameters, self.info_
        self.grid_ = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
        prefix = "embedding."
        weights = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
        self.embedding_ = Embedding(weights, num_margins=num_margins)
        num_inputs = len(info.state_names) + info.horizon * len(info.output_names)
        if parameters.is_sharpened:
            num_inputs += len(info.feature_names) * (2 if parameters.feature_unit else 1)
        if self.embedding_.num_inputs != num_inputs:
            raise ValueError(
                f"its maps take {self.embedding_.num_inputs} inputs, "
                f"its names amount to {num_inputs}"
            )
        self.training_points_ = tensors["training_points"]
        self.training_score_ = tensors["training_score"]
        self.training_cause_ = tensors["training_cause"]
        self.beliefs_ = tensors["beliefs"]
        expected = (
            self.embedding_.num_members,
            self.grid_.num_cells,
            3 + len(info.constraint_names),
        )
        if self.beliefs_.shape != expected:
            raise ValueError(f"its beliefs have shape {self.beliefs_.shape}, expected {expected}")


def _read(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileNotFoundError(f"there is no safety assessment at '{path}'")
    try:
        with safe_open(path, framework="numpy") as file:
            opened: Any = file
            metadata = dict(opened.metadata() or {})
            return metadata, {name: opened.get_tensor(name) for name in opened.keys()}
    except SafetensorError as error:
        raise ValueError(f"'{path}' is no safety assessment, or is truncated: {error}") from error
