"""The safety assessment function Γ: how likely the closed loop stays safe."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from drake_safety.extras import require_extra
from drake_safety.files.progress import StageProgress, shown, stage_of
from drake_safety.learning import assessment_file
from drake_safety.learning.adaptation import Adaptation, paper_beliefs
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.beliefs import empty
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD
from drake_safety.learning.calibration import Calibration, fitted_temperature
from drake_safety.learning.change_detector import ChangeDetector, usual_rows
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.feedback import (
    EpisodePair,
    check_feedback,
    feedback_segments,
    used_episodes,
)
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.maps import learned_maps
from drake_safety.learning.mode_settings import ModeSettings, mode_settings
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.points import embedded_points
from drake_safety.learning.prediction import LEARNED, BaseLogit, Correction, Model, Prediction
from drake_safety.learning.recalibration import recalibrated
from drake_safety.learning.seeds import UsedEpisodes, check_unused
from drake_safety.learning.segments import (
    DIVERGED,
    Episode,
    Episodes,
    EpisodesInfo,
    Segments,
    split,
    training_segments,
)
from drake_safety.learning.trained_maps import Embedding
from drake_safety.learning.training_scores import TrainingScores, prior_beliefs
from drake_safety.learning.trees import Trees

__all__ = ["AdaptationParameters", "AssessmentParameters", "Prediction", "SafetyAssessment"]

_LOGGER = logging.getLogger("drake_safety")


class SafetyAssessment:
    """Γ: maps the state and the desired preview to a belief about safety.

    `fit` learns it from nominal episodes. Learned attributes end in an underscore.

    Departure ("sharpened" only): x gains the safe set's signed margins along the plan (`features`).
    The maps learn safety and future margins beside t-SNE's points, from every start row. Γ is
    interpolated bilinearly between cell centres, and averaged over maps, each with its own grid.
    The "paper" mode is the literal reading, for comparison.

    Example: ``belief = assessment.predict_one(*inputs_at(legged_loop, start)).belief``
    """

    info_: EpisodesInfo  # Metadata of the training episodes.
    grid_: Grid
    columns_: InputColumns
    embedding_: Embedding
    detector_: ChangeDetector
    beliefs_: np.ndarray  # Beliefs of every map's cells, (K, R*R, 3 + n_c).
    training_: TrainingScores  # Adaptation starts from these.
    novelty_: Novelty
    base_logit_: BaseLogit | None  # None in the paper's mode.
    trees_: Trees | None
    fall_logit_: FallLogit | None  # Learned by `fit_falls`.
    correction_: Correction  # A term that feedback adds to the base logit.
    adaptation_: Adaptation | None
    used_: list[UsedEpisodes]  # Evaluation needs other episodes.
    calibrations_: dict[str, Calibration]  # By kind.

    def __init__(self, parameters: AssessmentParameters | None = None):
        # A copy, so that later changes of a scenario do not change a trained assessment.
        self.parameters = copy.deepcopy(parameters or AssessmentParameters())

    @property
    def settings(self) -> ModeSettings:
        """Parameters of the stages of learning in this mode."""
        return mode_settings(self.parameters)

    @property
    def uses_features(self) -> bool:
        """Whether x contains the features, as in the sharpened mode."""
        return self.parameters.mode != "paper"

    @property
    def knows_family(self) -> bool:
        """Whether it has learned from a family of plants beside the nominal one."""
        return any(one.purpose == "training on the family" for one in self.used_)

    @property
    def feature_names(self) -> list[str]:
        """Names of the features that the training episodes have, in their order, (n_f,)."""
        return self.info_.feature_names

    @property
    def model(self) -> Model:
        """All that a prediction is made from, as one object of the present learned attributes."""
        self._check_fitted()
        learned = {name: getattr(self, f"{name}_") for name in LEARNED}
        return Model(**learned, initial_uncertainty=self.parameters.initial_uncertainty)

    def fit(
        self,
        episodes: Episodes,
        progress: StageProgress | bool | None = None,
        *,
        family: Episodes | None = None,
        detector: ChangeDetector | None = None,
        motions: Episodes | None = None,
    ) -> SafetyAssessment:
        """Learns embedding and beliefs from nominal episodes, and from episodes of a plant family.

        Args:
            progress: Called with a stage, the percentage done and 100; True shows it.
            detector: The monitor; by default it is learned.
            motions: Long undisturbed motions of the same diagram, of which it is learned; by
                default the episodes, whose motion rarely suffices for its limits.
        """
        require_extra("train", "SafetyAssessment.fit")
        self.parameters.check()
        if family is not None and self.settings.is_paper:
            raise ValueError("SafetyAssessment.fit: mode 'paper' learns from one plant, no family")
        episodes.warn()
        # The order of sums depends on the number of threads, and the last bits with it.
        with (
            threadpool_limits(1, user_api="blas"),
            shown(progress, lambda stages: stages) as report,
        ):
            if detector is None:
                sets = (episodes, None) if motions is None else (motions, episodes)
                of_monitor = stage_of(report, "monitor")
                detector = ChangeDetector.fit(sets[0], of_monitor, episodes=sets[1])
            vars(self).update(self._learned(episodes, family, report), detector_=detector)
        if math.isinf(detector.alarm_level):
            _LOGGER.warning("SafetyAssessment.fit: %s", detector.describe())
        return self

    def _learned(
        self, nominal: Episodes, family: Episodes | None, progress: StageProgress | None
    ) -> dict[str, Any]:
        """The learned attributes but the detector, stage by stage."""
        parameters, info = self.parameters, nominal.info
        episodes = nominal if family is None else nominal.joined(family)
        used = [UsedEpisodes.of("training", info, len(nominal))]
        if family is not None:
            used.append(UsedEpisodes.of("training on the family", family.info, len(family)))
        segments = training_segments(episodes, parameters)
        grid, columns = Grid.of(parameters), InputColumns(info, parameters)
        points = embedded_points(segments, grid, parameters, progress)
        embedding, base_logit, trees = learned_maps(
            segments, points, columns, parameters, stage_of(progress, "training")
        )
        every = split(episodes, stride=1, discount=1.0, shortest=1)
        novelty = Novelty.fit(
            # With noise in either mode, as on a robot.
            columns.of(every.state, every.desired_preview, every.features),
            every.episode,
            every.is_unsafe,
            parameters.novelty_rate,
            range_limit=parameters.novelty_range,
            plan=columns.plan,
        )
        num_causes = len(info.constraint_names)
        model = Model(
            embedding=embedding,
            grid=grid,
            beliefs=empty((embedding.num_members, grid.num_cells), num_causes),
            correction=Correction.none(embedding, grid, trees),
            novelty=novelty,
            base_logit=base_logit,
            trees=trees,
            initial_uncertainty=parameters.initial_uncertainty,
        )
        training = TrainingScores.of(segments, model.evaluate(columns.of_rows(segments)))
        training = training.thinned(grid, parameters.seed)
        model = replace(model, beliefs=prior_beliefs(training, grid, parameters, num_causes))
        stage_of(progress, "beliefs")(1.0)
        return {f"{name}_": getattr(model, name) for name in LEARNED} | {
            "info_": info,
            "columns_": columns,
            "training_": training,
            "adaptation_": None,
            "calibrations_": {},
            "used_": used,
        }

    def fit_falls(self, episodes: Episodes, features: Sequence[str]) -> SafetyAssessment:
        """Fits the probability of a fall to episodes that go on after they leave the safe set.

        Their seeds are unused and their unsafe end is a fall; `features` are read beside predicted
        margins and base logit.
        """
        require_extra("train", "SafetyAssessment.fit_falls", "sklearn")
        model, names = self.model, self.columns_.names
        if model.base_logit is None:
            raise ValueError(f"{self._who}: the probability of a fall needs maps with heads")
        if unknown := sorted(set(features) - set(names)):
            raise ValueError(f"{self._who}: unknown features {unknown}; the features are {names}")
        self.check_unused(episodes.info.seed, purpose="falls")
        columns = [names.index(name) for name in features]
        labelled = [episode for episode in episodes if episode.cause != DIVERGED]
        inputs = []
        for episode in labelled:
            end = len(episode.time_s) - (not episode.is_safe)
            x = self.columns_.of_rows(episode)[episode.first_step : end]
            evaluation = model.evaluate(x)
            assert evaluation.logit is not None
            inputs.append(FallLogit.inputs(evaluation.margins, evaluation.logit, x, columns))
        has_fallen = [not episode.is_safe for episode in labelled]
        self.fall_logit_ = FallLogit.fit(inputs, has_fallen, columns)
        self._replace_used("falls", [UsedEpisodes.of("falls", episodes.info, len(episodes))])
        return self

    def adapt(
        self,
        feedback: Sequence[EpisodePair],
        *,
        motions: Episodes | Sequence[np.ndarray] | None = None,
    ) -> SafetyAssessment:
        """Returns a copy adapted to feedback from the actual robot.

        In the paper's mode, a discrepancy function and feedback beliefs update the beliefs; when
        sharpened, base logit and training scores are recalibrated. Every adaptation starts from the
        nominal episodes, as F is not associative: pass all feedback, not only the new pairs.

        The monitor learns `motions` of the actual robot as well. They may be rows (state, desired
        preview, features), (K, n) each, as far apart as in its training.
        """
        require_extra("train", "SafetyAssessment.adapt", "sklearn")
        model, columns, parameters = self.model, self.columns_, self.parameters
        parameters.check()
        check_feedback(feedback, self.info_)
        used = used_episodes(feedback)
        self.check_unused(*{one_set.seed for one_set in used}, purpose="adaptation")
        segments = feedback_segments(feedback, parameters)
        adapted = copy.copy(self)
        adapted.parameters = copy.deepcopy(parameters)
        rows = [pair.rows for pair in feedback]
        x = np.concatenate([columns.of(r.state, r.desired_preview, r.features) for r in rows])
        adapted.novelty_ = self.novelty_.with_feedback(x, parameters.novelty_rate)
        if isinstance(motions, Episodes):
            motions = self._monitored_rows(motions)
        if motions is not None:
            adapted.detector_ = self.detector_.with_motions(motions)
        # The thresholds' promises hold for the old beliefs only.
        adapted.calibrations_ = {}
        adapted._replace_used("adaptation", used)
        if model.base_logit is None:
            x = columns.of(segments.state, segments.desired_preview, segments.features)
            points = model.embedding.embed(x)
            adapted.beliefs_ = paper_beliefs(
                self.training_, segments, points, model.grid, parameters, model.num_causes
            )
        else:
            adapted.correction_, adapted.beliefs_ = recalibrated(
                model, feedback, segments, self.training_, columns, parameters
            )
        adapted.adaptation_ = Adaptation(
            method="paper" if model.base_logit is None else "recalibration",
            variation=feedback[0].info.variation,
            num_sets=len(feedback),
            num_differing=sum(pair.differs for pair in feedback),
        )
        return adapted

    def _monitored_rows(self, motions: Episodes) -> list[np.ndarray]:
        step_s, trained_step_s = motions.info.step_s, self.detector_.step_s
        stride = round(trained_step_s / step_s)
        if not math.isclose(stride * step_s, trained_step_s):
            who = f"{self._who}: rows of the motions are {step_s} s apart"
            raise ValueError(f"{who}, which does not divide {trained_step_s} s, the monitor's")
        return [rows[::stride] for rows in usual_rows(motions)]

    def _replace_used(self, purpose: str, used: Sequence[UsedEpisodes]) -> None:
        self.used_ = [*(kept for kept in self.used_ if kept.purpose != purpose), *used]

    def check_unused(self, *seeds: int, purpose: str = "") -> None:
        """Checks that seeds are unused; sets of the `purpose`, which they replace, are ignored."""
        self._check_fitted()
        check_unused([used for used in self.used_ if used.purpose != purpose], seeds, self._who)

    def temper(self, segments: Segments) -> float:
        """Divides the base logit by the temperature at which it predicts fresh episodes best.

        Training starts are disturbed more than others, so that its logit may be too sure, or not
        sure enough. Returns the temperature: 1 in the paper's mode and after an adaptation.
        """
        if self.base_logit_ is None or self.adaptation_ is not None:
            return 1.0
        probability = self.predict_rows(segments).probability
        temperature = fitted_temperature(probability, segments.is_unsafe)
        self.base_logit_ = self.base_logit_.at(temperature)
        if self.fall_logit_ is not None:
            self.fall_logit_ = self.fall_logit_.at(temperature)
        return temperature

    def adopt_calibrations(self, calibrations: Sequence[Calibration], *sets: Episodes) -> None:
        """Replaces the calibrations, which were chosen on some sets of episodes."""
        self.check_unused(*(one.info.seed for one in sets), purpose="calibration")
        self.calibrations_ = {calibration.key: calibration for calibration in calibrations}
        used = [UsedEpisodes.of("calibration", one.info, len(one)) for one in sets]
        self._replace_used("calibration", used)

    def inputs_of(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """Returns x, (..., n_x), from the arguments of `predict`."""
        self._check_fitted()
        return self.columns_.of(state, desired_preview, features)

    @property
    def _who(self) -> str:
        return f"SafetyAssessment of '{self.info_.scenario}'"

    def _check_fitted(self) -> None:
        if not hasattr(self, "beliefs_"):
            raise ValueError("SafetyAssessment: not fitted or loaded yet")

    def predict(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        **learned: Any,
    ) -> Prediction:
        """Assesses N inputs; novel inputs and inputs that are not finite get the empty belief.

        A row has the same bits whatever the others are.

        Args:
            state: Measured states, (N, n_s).
            desired_preview: Desired outputs over the horizon, row-major in time, (N, H*n_z).
            features: (N, n_f); ignored in the paper's mode.
            **learned: `beliefs`, `correction` or `novelty` in place of the assessment's own.
        """
        return self._predict(self._checked_inputs(2, state, desired_preview, features), **learned)

    def predict_one(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        **learned: Any,
    ) -> Prediction:
        """Assesses one input, with the same bits as `predict`.

        Args:
            state: Measured state, (n_s,).
            desired_preview: Desired outputs over the horizon, row-major in time, (H*n_z,).
            features: (n_f,); ignored in the paper's mode.
            **learned: As of `predict`.
        """
        x = self._checked_inputs(1, state, desired_preview, features)[None]
        return self._predict(x, **learned).one(0)

    def predict_rows(self, rows: Episode | Segments, variation: str = "nominal") -> Prediction:
        """Assesses recorded rows of a plant; see `InputColumns.of_rows`."""
        return self._predict(self.columns_.of_rows(rows, variation))

    @ONE_BLAS_THREAD
    def _predict(self, x: np.ndarray, **learned: Any) -> Prediction:
        own = self.model
        model = replace(own, **learned) if learned else own
        if (given := model.shapes) != (expected := own.shapes):
            what = f"beliefs and correction have the shapes {given}"
            raise ValueError(f"{self._who}: {what}, expected {expected}")
        return model.predict(x)

    def _checked_inputs(self, ndim: int, state: np.ndarray, *others: Any) -> np.ndarray:
        x = self.inputs_of(state, *others)
        if x.ndim != ndim:
            raise ValueError(f"{self._who}: state has {np.ndim(state)} axes, expected {ndim}")
        return x

    def strangest_input(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> tuple[str, float]:
        """Returns the entry of x that contradicts the others most, and by how much [std dev]."""
        difference = self.novelty_.contradictions(self.inputs_of(state, desired_preview, features))
        column = int(np.argmax(np.abs(difference)))
        return self.columns_.names[column], float(difference[column])

    def unsafe_logits(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns x, the maps' mean logit (N,) of an unsafe end and its gradient, (N, n_x) both.

        Unlike the belief, this logit has a slope everywhere.
        """
        x = self.inputs_of(state, desired_preview, features)
        return x, *self.embedding_.logit_gradient(x)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one safetensors file atomically."""
        self._check_fitted()
        learned = {name: value for name, value in vars(self).items() if name.endswith("_")}
        assessment_file.write(Path(path), self.parameters, learned)

    def to_onnx(self, path: str | os.PathLike[str], part: str = "gamma") -> None:
        """Writes `predict` as it is now as one ONNX graph, atomically; see docs/export.md.

        Other parts are the "assessor", which heeds margins and alarm, and the "monitor".
        """
        from drake_safety.learning import onnx_graph

        self._check_fitted()
        onnx_graph.write(Path(path), self, part)

    def to_c(self, path: str | os.PathLike[str], prefix: str | None = None) -> list[Path]:
        """Writes assessor and monitor as C99: a source, its header and an example.

        The prefix of all names is by default the name of the source. Returns the files.
        """
        from drake_safety.learning import c_source

        self._check_fitted()
        return c_source.write(Path(path), self, prefix)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SafetyAssessment:
        """Reads a file written by `save`."""
        parameters, learned = assessment_file.read(Path(path))
        assessment = cls(parameters)
        vars(assessment).update(learned)
        return assessment
