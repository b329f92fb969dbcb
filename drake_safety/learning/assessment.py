"""The safety assessment function Gamma: how likely the closed loop stays safe from here on."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.learning import adaptation, assessment_file, prediction
from drake_safety.learning.adaptation import Adaptation, TrainingScores
from drake_safety.learning.assessment_parameters import (
    MODES,
    AdaptationParameters,
    AssessmentParameters,
)
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.feedback import (
    FeedbackSegments,
    FeedbackSet,
    check_feedback,
    segments_of,
)
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import check_width, input_parts, num_inputs
from drake_safety.learning.prediction import Assessment, Assessments, BaseLogit
from drake_safety.learning.segments import Episodes
from drake_safety.learning.trained_maps import INPUT_LIMIT, Embedding
from drake_safety.learning.training import fitted_base_logit, learned_maps, segments_for

__all__ = [
    "MODES",
    "AdaptationParameters",
    "Assessment",
    "AssessmentParameters",
    "Assessments",
    "SafetyAssessment",
]

ADAPTATION_METHODS = ("shift", "paper")


class SafetyAssessment:
    """Gamma: from the state and the desired outputs ahead to a belief about safety.

    `fit` learns it from nominal episodes. Learned attributes end in an underscore:

    - `info_`: the `EpisodesInfo` of the training episodes.
    - `grid_`: the `Grid` of the embedding space.
    - `embedding_`: the maps Psi, an `Embedding`, immutable.
    - `beliefs_`: the belief of every map's cells, (K, R*R, 3 + n_c); it may be replaced, and every
      prediction takes other beliefs as an argument.
    - `training_points_`, `training_score_`, `training_cause_`: Psi(x), lambda and the cause of the
      segments in the cells, (K, N, 2), (N,), (N,), which adaptation starts from; where the maps
      have heads also `training_logit_` and `training_nearest_`, the `BaseLogit` L of the segments
      and the constraint that is predicted to be nearest, (N,), (N,).
    - `base_logit_`: L, which scales the maps' heads to one logit; None without heads.
    - `shift_`: what feedback adds to L in every map's cells, (K, R*R); zero before any.
    - `adaptation_`: the `Adaptation` to feedback; None before any.
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

    @property
    def num_causes(self) -> int:
        """n_c, the number of constraints that can be violated."""
        return len(self.info_.constraint_names)

    def fit(
        self, episodes: Episodes, progress: Callable[[str, float], None] | None = None
    ) -> SafetyAssessment:
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
        training = segments_for(episodes, parameters)
        segments = training.segments
        self.grid_ = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
        x = self._inputs(
            segments.state if parameters.is_sharpened else segments.true_state,
            segments.desired_preview,
            segments.features if parameters.is_sharpened else None,
        )
        self.embedding_, is_held_out = learned_maps(training, x, self.grid_, parameters, progress)
        self.info_ = info
        output = self.embedding_.evaluate(x)
        self.training_points_ = output.embedding.astype(np.float32)
        self.training_score_ = _single(segments.score)
        self.training_cause_ = segments.cause
        self.base_logit_: BaseLogit | None = None
        self.training_logit_ = self.training_nearest_ = None
        if self.embedding_.has_heads:
            margins = output.margins.mean(axis=0)
            self.base_logit_ = fitted_base_logit(output, is_held_out, segments, parameters)
            self.training_logit_ = _single(self.base_logit_.of_output(output))
            self.training_nearest_ = (
                margins.argmin(axis=1)
                if margins.shape[1]
                else np.zeros(len(segments), dtype=np.int64)
            )
        self.adaptation_: Adaptation | None = None
        self.calibrations_: dict[str, Calibration] = {}
        self.shift_ = np.zeros((self.embedding_.num_members, self.grid_.num_cells))
        self.beliefs_ = adaptation.prior_beliefs(
            self._training, self.grid_, parameters, self.num_causes
        )
        if progress is not None:
            progress("beliefs", 1.0)
        return self

    def prior_beliefs(self) -> np.ndarray:
        """The belief of every map's cells before any feedback, (K, R*R, 3 + n_c)."""
        self._check_fitted()
        return adaptation.prior_beliefs(
            self._training, self.grid_, self.parameters, self.num_causes
        )

    @property
    def _training(self) -> TrainingScores:
        return TrainingScores(
            points=self.training_points_,
            score=self.training_score_,
            cause=self.training_cause_,
            logit=self.training_logit_,
            nearest=self.training_nearest_,
        )

    def adapt(
        self, feedback: Sequence[FeedbackSet], *, method: str | None = None
    ) -> SafetyAssessment:
        """Adapts to what the actual robot did; this assessment stays as it is.

        Every adaptation starts from the nominal episodes, as F is not associative: give all
        feedback there is, not only what is new.

        Departure ("shift"): see `adaptation.shifted_beliefs`.

        Args:
            feedback: Pairs of actual episodes and their nominal twins.
            method: "shift" moves logit and scores by one number; "paper" is the paper's update, by
                a discrepancy function and feedback beliefs. By default what the mode is called
                for: "paper" in the paper's mode and without heads, else "shift".

        Returns:
            Another assessment with the same maps.

        Raises:
            ValueError: Unknown method, maps without heads for "shift", no feedback, or feedback of
                another scenario.
        """
        self._check_fitted()
        has_heads = self.base_logit_ is not None
        method = method or ("shift" if has_heads else "paper")
        if method not in ADAPTATION_METHODS or (method == "shift" and not has_heads):
            raise ValueError(
                f"SafetyAssessment of '{self.info_.scenario}': cannot adapt by '{method}'; the "
                f"methods are {list(ADAPTATION_METHODS)}, and 'shift' takes maps with heads"
            )
        check_feedback(feedback, self.info_)
        segments = self.feedback_segments(feedback)
        output = self.embedding_.evaluate(
            self._inputs(segments.state, segments.desired_preview, segments.features)
        )
        points = output.embedding
        adapted = copy.copy(self)
        # What was promised was promised of other beliefs.
        adapted.calibrations_ = {}
        arguments = (self.grid_, self.parameters, self.num_causes)
        b = 0.0
        adapted.shift_ = np.zeros_like(self.shift_)
        if method == "paper":
            adapted.beliefs_ = adaptation.paper_beliefs(
                self._training, segments, points, *arguments
            )
        elif self.base_logit_ is not None:
            # Outcomes are what counts: with the same ones on both sides there is no evidence.
            if any(one.differs for one in feedback):
                b = self._fitted_shift(feedback)
            adapted.shift_ = adaptation.cell_shift(b, segments, points, self.grid_)
            adapted.beliefs_ = adaptation.shifted_beliefs(
                self._training, adapted.shift_, *arguments
            )
        adapted.adaptation_ = Adaptation(
            method=method,
            variation=feedback[0].info.variation,
            num_sets=len(feedback),
            num_differing=sum(one.differs for one in feedback),
            shift=b,
        )
        return adapted

    def _fitted_shift(self, feedback: Sequence[FeedbackSet]) -> float:
        assert self.base_logit_ is not None
        actual = [(one.state[0], one.desired_preview[0], one.features[0]) for one in feedback]
        twins = [(one.twin_state, one.twin_desired_preview, one.twin_features) for one in feedback]
        logit, twin_logit = (
            self.base_logit_.of_output(self.embedding_.evaluate(self._inputs(*map(np.array, x))))
            for x in (zip(*actual, strict=True), zip(*twins, strict=True))
        )
        return adaptation.fitted_shift(
            adaptation.Outcomes(logit=logit, is_unsafe=np.array([o.is_unsafe for o in feedback])),
            adaptation.Outcomes(
                logit=twin_logit, is_unsafe=np.array([o.nominal_is_unsafe for o in feedback])
            ),
            prior_std=self.parameters.adaptation.shift_std,
        )

    def feedback_segments(self, feedback: Sequence[FeedbackSet]) -> FeedbackSegments:
        """The segments of feedback sets, cut as the training episodes were."""
        parameters = self.parameters
        return segments_of(
            feedback,
            stride=parameters.stride,
            shortest=parameters.shortest,
            discount=parameters.discount,
            plain=not parameters.is_sharpened,
        )

    def _inputs(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """x, (N, n_x): [s; z*] in the paper's mode, [s; z*; features] in the sharpened one."""
        parts = input_parts(
            np.asarray(state, dtype=float),
            np.asarray(desired_preview, dtype=float),
            None if features is None else np.asarray(features, dtype=float),
            self.parameters,
        )
        return np.concatenate(parts, axis=-1)

    def _check_fitted(self) -> None:
        if not hasattr(self, "beliefs_"):
            raise ValueError("SafetyAssessment: it has not been fitted or loaded yet")

    def _cells(
        self, beliefs: np.ndarray | None, shift: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        beliefs = self.beliefs_ if beliefs is None else beliefs
        shift = self.shift_ if shift is None else shift
        for name, given, own in (
            ("beliefs", beliefs, self.beliefs_),
            ("shifts", shift, self.shift_),
        ):
            if given.shape != own.shape:
                raise ValueError(
                    f"SafetyAssessment: {name} have shape {given.shape}, expected {own.shape}"
                )
        return beliefs, shift

    def predict(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        beliefs: np.ndarray | None = None,
        shift: np.ndarray | None = None,
    ) -> Assessments:
        """Assesses N inputs.

        Args:
            state: States as the assessor sees them, (N, n_s).
            desired_preview: Coming desired outputs, row-major in time, (N, H*n_z).
            features: Features, (N, n_f); the paper's mode has no use for them.
            beliefs: Beliefs of the cells instead of `beliefs_`, (K, R*R, 3 + n_c).
            shift: Shifts of the cells instead of `shift_`, (K, R*R).

        Returns:
            The assessments. An input that is not finite is empty: Gamma is 0 there.

        Raises:
            ValueError: The widths or a shape are wrong, or there is nothing learned yet.
        """
        self._check_fitted()
        beliefs, shift = self._cells(beliefs, shift)
        x = self._inputs(state, desired_preview, features)
        if x.ndim != 2:
            raise ValueError(f"SafetyAssessment: inputs have {x.ndim} axes, expected (N, columns)")
        check_width(x.shape[1], self.info_, self.parameters)
        with np.errstate(over="ignore", invalid="ignore"):
            is_usable = np.einsum("ij,ij->i", x, x) < INPUT_LIMIT
        return prediction.predict(
            np.where(is_usable[:, None], x, np.nan),
            embedding=self.embedding_,
            grid=self.grid_,
            beliefs=beliefs,
            shift=shift,
            base_logit=self.base_logit_,
            is_sharpened=self.parameters.is_sharpened,
        )

    def predict_one(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        beliefs: np.ndarray | None = None,
        shift: np.ndarray | None = None,
    ) -> Assessment:
        """Assesses one input; the arguments are those of `predict` without the axis N."""
        self._check_fitted()
        row = self.predict_row(state, desired_preview, features, *self._cells(beliefs, shift))
        num_columns = self.beliefs_.shape[2]
        return Assessment(
            safety_probability=float(row[0]),
            normalized=float(row[1]),
            belief=row[2:5],
            cause_probability=row[5 : 2 + num_columns],
            embedding=row[2 + num_columns : 4 + num_columns],
            predicted_margins=row[4 + num_columns : -1],
            calibrated=float(row[-1]),
        )

    def predict_row(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None,
        beliefs: np.ndarray,
        shift: np.ndarray,
    ) -> np.ndarray:
        """`predict_one` as one vector, for the online run.

        Returns:
            The fields of `Assessment` one after the other, in their order, (8 + 2 n_c,).
        """
        parts = input_parts(state, desired_preview, features, self.parameters)
        width = sum(map(len, parts))
        if width != self.embedding_.num_inputs:
            check_width(width, self.info_, self.parameters)
        return prediction.predict_row(
            parts,
            embedding=self.embedding_,
            grid=self.grid_,
            beliefs=beliefs,
            shift=shift,
            base_logit=self.base_logit_,
            is_sharpened=self.parameters.is_sharpened,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one safetensors file, first under a temporary name: it is whole or absent."""
        self._check_fitted()
        tensors: dict[str, np.ndarray] = {
            f"embedding.{name}": w for name, w in self.embedding_.weights.items()
        }
        tensors |= {
            "beliefs": self.beliefs_,
            "shift": self.shift_,
            "training_points": self.training_points_,
            "training_score": self.training_score_.astype(np.float32),
            "training_cause": self.training_cause_.astype(np.int16),
        }
        if self.training_logit_ is not None and self.training_nearest_ is not None:
            tensors["training_logit"] = self.training_logit_.astype(np.float32)
            tensors["training_nearest"] = self.training_nearest_.astype(np.int16)
        assessment_file.write(
            Path(path),
            parameters=self.parameters,
            info=self.info_,
            adaptation=self.adaptation_,
            numbers={
                "num_margins": self.embedding_.num_margins,
                "base_logit": None if self.base_logit_ is None else asdict(self.base_logit_),
                "calibrations": [one.to_json() for one in self.calibrations_.values()],
            },
            tensors=tensors,
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SafetyAssessment:
        """Reads what `save` wrote.

        Raises:
            ValueError: The file is truncated, of another kind, or of another schema version.
        """
        entries, tensors = assessment_file.read(Path(path))
        assessment = cls(entries["parameters"])
        try:
            assessment.info_ = entries["info"]
            assessment.adaptation_ = entries["adaptation"]
            assessment._restore(tensors, **entries["numbers"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"'{path}' is a damaged safety assessment: {error}") from error
        return assessment

    def _restore(
        self,
        tensors: dict[str, np.ndarray],
        *,
        num_margins: int,
        base_logit: dict[str, Any] | None,
        calibrations: list[dict[str, Any]],
    ) -> None:
        parameters, info = self.parameters, self.info_
        self.grid_ = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
        prefix = "embedding."
        weights = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
        self.embedding_ = Embedding(weights, num_margins=num_margins)
        if self.embedding_.num_inputs != num_inputs(info, parameters):
            raise ValueError(
                f"its maps take {self.embedding_.num_inputs} inputs, "
                f"its names amount to {num_inputs(info, parameters)}"
            )
        self.training_points_ = tensors["training_points"]
        self.training_score_ = _single(tensors["training_score"])
        self.training_cause_ = tensors["training_cause"].astype(np.int64)
        logit, nearest = tensors.get("training_logit"), tensors.get("training_nearest")
        self.training_logit_ = None if logit is None else _single(logit)
        self.training_nearest_ = None if nearest is None else nearest.astype(np.int64)
        self.base_logit_ = None
        if base_logit is not None:
            low, high = base_logit["margin_range"]
            self.base_logit_ = BaseLogit(**base_logit | {"margin_range": (low, high)})
        stored = [Calibration(**one) for one in calibrations]
        self.calibrations_ = {one.kind: one for one in stored}
        self.beliefs_ = tensors["beliefs"]
        self.shift_ = tensors["shift"]
        expected = (
            self.embedding_.num_members,
            self.grid_.num_cells,
            3 + len(info.constraint_names),
        )
        if self.beliefs_.shape != expected:
            raise ValueError(f"its beliefs have shape {self.beliefs_.shape}, expected {expected}")
        if self.shift_.shape != expected[:2]:
            raise ValueError(f"its shifts have shape {self.shift_.shape}, expected {expected[:2]}")


def _single(values: np.ndarray) -> np.ndarray:
    """Values that single precision holds, as doubles: files keep one number for every segment."""
    return values.astype(np.float32).astype(float)
