"""The safety assessment function Γ: how likely the closed loop stays safe."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.progress import StageProgress, shown, stage_of
from drake_safety.learning import adaptation, assessment_file, prediction
from drake_safety.learning.adaptation import Adaptation
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.blas_threads import one_blas_thread
from drake_safety.learning.calibration import Calibration
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
from drake_safety.learning.prediction import BaseLogit, Correction, Prediction
from drake_safety.learning.recalibration import recalibrated_beliefs
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

__all__ = [
    "AdaptationParameters",
    "AssessmentParameters",
    "Prediction",
    "SafetyAssessment",
]

_LOGGER = logging.getLogger("drake_safety")


class SafetyAssessment:
    """Γ: maps the state and the desired preview to a belief about safety.

    `fit` learns it from nominal episodes. Learned attributes end in an underscore:

    - `info_`: the `EpisodesInfo` of the training episodes.
    - `grid_`: the `Grid` of the embedding space.
    - `columns_`: the `InputColumns` of x.
    - `embedding_`: the maps Psi, an immutable `Embedding`.
    - `detector_`: the `ChangeDetector`, which sees a changed plant or sensor, for a monitor.
    - `beliefs_`: the beliefs of every map's cells, (K, R*R, 3 + n_c). They may be replaced, and
      predictions take other beliefs as an argument.
    - `training_`: the `TrainingScores`, the embedded training segments, from which adaptation
      starts; crowded cells keep some of their segments.
    - `novelty_`: the `Novelty`, which says which inputs are unlike those of training.
    - `base_logit_`: the `BaseLogit`, which scales the maps' heads and the trees to one logit; None
      without heads.
    - `trees_`: the `Trees` beside the maps; None where none are learned.
    - `fall_logit_`: the `FallLogit`, of `fit_falls`; initially None.
    - `correction_`: the `Correction` that feedback adds to the base logit; initially zero.
    - `adaptation_`: the `Adaptation` to feedback; initially None.
    - `used_`: every set of episodes used for training, calibration or adaptation, as
      `UsedEpisodes`; evaluation needs other seeds.
    - `calibrations_`: the `Calibration` by kind for these maps and `beliefs_`; initially empty.

    Departure ("sharpened" only): x gains the safe set's signed margins along the plan (`features`),
    the maps learn safety and future margins beside t-SNE's points from every start row, Γ is
    interpolated bilinearly between cell centres, and it is the mean of an ensemble of maps, each
    with its own grid. Read literally, the method is weak on the robots; the "paper" mode is that
    reading, for comparison.
    """

    info_: EpisodesInfo
    grid_: Grid
    columns_: InputColumns
    embedding_: Embedding
    detector_: ChangeDetector
    beliefs_: np.ndarray
    training_: TrainingScores
    novelty_: Novelty
    base_logit_: BaseLogit | None
    trees_: Trees | None
    fall_logit_: FallLogit | None
    correction_: Correction
    adaptation_: Adaptation | None
    used_: list[UsedEpisodes]
    calibrations_: dict[str, Calibration]

    def __init__(self, parameters: AssessmentParameters | None = None):
        # A copy, so that later changes of a scenario do not change a trained assessment.
        self.parameters = copy.deepcopy(parameters or AssessmentParameters())

    def __repr__(self) -> str:
        mode = f"mode '{self.parameters.mode}'"
        if not hasattr(self, "beliefs_"):
            return f"SafetyAssessment({mode}, not fitted)"
        words = [f"'{self.info_.scenario}'", mode, f"{len(self.beliefs_)} maps"]
        for one in self.used_:
            words.append(f"{one.purpose} on {one.num_episodes} episodes of '{one.variation}'")
        return f"SafetyAssessment({', '.join(words)})"

    @property
    def settings(self) -> ModeSettings:
        """What the stages of learning read of the parameters in this mode."""
        return mode_settings(self.parameters)

    @property
    def uses_features(self) -> bool:
        """Whether x contains the features, as in the sharpened mode."""
        return self.settings.uses_features

    @property
    def feature_names(self) -> list[str]:
        """Names of the features that the training episodes have, in their order, (n_f,)."""
        return self.info_.feature_names

    def fit(
        self,
        episodes: Episodes,
        progress: StageProgress | bool | None = None,
        *,
        detector: ChangeDetector | None = None,
        motions: Episodes | None = None,
    ) -> SafetyAssessment:
        """Learns embedding and beliefs from nominal episodes.

        Args:
            progress: Called with a stage ("distances", "t-SNE", "training", "beliefs", "monitor"),
                the percentage done and 100; True shows it.
            detector: That of undisturbed motion.
            motions: Long undisturbed motions of the same diagram, from which the detector is
                learned in its place. By default it is learned from the episodes, whose motion
                rarely suffices for its limits.
        """
        require_extra("train", "SafetyAssessment.fit")
        self.parameters.check()
        episodes.warn()
        from threadpoolctl import threadpool_limits

        # The order of sums depends on the number of threads, and the last bits with it.
        with (
            threadpool_limits(1, user_api="blas"),
            shown(progress, lambda stages: stages) as report,
        ):
            if detector is None:
                together = (episodes, None) if motions is None else (motions, episodes)
                of_monitor = stage_of(report, "monitor")
                detector = ChangeDetector.fit(together[0], of_monitor, episodes=together[1])
            vars(self).update(self._learned(episodes, report, detector))
        if math.isinf(detector.alarm_level):
            _LOGGER.warning("SafetyAssessment.fit: %s", detector.describe())
        return self

    def _learned(
        self,
        episodes: Episodes,
        progress: StageProgress | None,
        detector: ChangeDetector,
    ) -> dict[str, Any]:
        """The learned attributes, stage by stage."""
        parameters, info = self.parameters, episodes.info
        segments = training_segments(episodes, parameters)
        grid, columns = Grid.of(parameters), InputColumns(info, parameters)
        points = embedded_points(segments, grid, parameters, progress)
        embedding, base_logit, trees = learned_maps(
            segments, points, columns, parameters, stage_of(progress, "training")
        )
        x = columns.of_rows(segments)
        trees_logit = None if trees is None else trees.evaluate(x)
        training = TrainingScores.of(segments, embedding.evaluate(x), base_logit, trees_logit)
        training = training.thinned(grid, parameters.seed)
        beliefs = prior_beliefs(training, grid, parameters, len(info.constraint_names))
        stage_of(progress, "beliefs")(1.0)
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
        return {
            "info_": info,
            "grid_": grid,
            "columns_": columns,
            "embedding_": embedding,
            "base_logit_": base_logit,
            "trees_": trees,
            "fall_logit_": None,
            "training_": training,
            "beliefs_": beliefs,
            "novelty_": novelty,
            "detector_": detector,
            "correction_": Correction.none(embedding, grid, trees),
            "adaptation_": None,
            "calibrations_": {},
            "used_": [UsedEpisodes.of("training", info, len(episodes))],
        }

    def fit_falls(self, episodes: Episodes, features: Sequence[str]) -> SafetyAssessment:
        """Fits the probability of a fall to episodes that go on after they leave the safe set.

        Args:
            episodes: Episodes whose unsafe end is a fall, as those of `run_episodes` with
                ``until_fall``, of seeds without other use.
            features: Features that it reads beside predicted margins and base logit.
        """
        require_extra("train", "SafetyAssessment.fit_falls", "sklearn")
        self._check_fitted()
        if self.base_logit_ is None or not self.embedding_.num_margins:
            raise ValueError(f"{self._who}: the probability of a fall needs maps with margin heads")
        names = self.columns_.names
        if unknown := sorted(set(features) - set(names)):
            raise ValueError(f"{self._who}: there are no features {unknown} among {names}")
        self.check_unused(episodes.info.seed, purpose="falls")
        columns = [names.index(name) for name in features]
        labelled = [one for one in episodes if one.cause != DIVERGED]
        inputs = []
        for one in labelled:
            x = self.columns_.of_rows(one)[one.first_step : len(one.time_s) - (not one.is_safe)]
            output = self.embedding_.evaluate(x)
            margins = prediction.mean_of_maps(output.margins)
            trees_logit = None if self.trees_ is None else self.trees_.evaluate(x)
            heads = self.base_logit_.heads(output, trees_logit, margins)
            unsafe_logit = self.base_logit_.of_heads(heads)
            inputs.append(FallLogit.inputs(margins, unsafe_logit, x, columns))
        self.fall_logit_ = FallLogit.fit(inputs, [not one.is_safe for one in labelled], columns)
        kept = [one for one in self.used_ if one.purpose != "falls"]
        self.used_ = [*kept, UsedEpisodes.of("falls", episodes.info, len(episodes))]
        return self

    def adapt(
        self,
        feedback: Sequence[EpisodePair],
        *,
        method: str | None = None,
        motions: Episodes | Sequence[np.ndarray] | None = None,
    ) -> SafetyAssessment:
        """Returns a copy adapted to feedback from the actual robot.

        Every adaptation starts from the nominal episodes, as F is not associative: pass all
        feedback, not only the new pairs.

        Departure ("recalibration"): see `recalibration.recalibrated_beliefs`.

        Args:
            method: "recalibration" corrects the base logit and with it the training scores;
                "paper" is the paper's update by a discrepancy function and feedback beliefs.
                Default: "recalibration" for maps with heads, else "paper".
            motions: Motion of the actual robot that the monitor is to know as well, or its rows
                (state, desired preview, features), (K, n) each, as far apart as in its training;
                of motion with more rows those between are left out.
        """
        require_extra("train", "SafetyAssessment.adapt", "sklearn")
        self._check_fitted()
        parameters, columns = self.parameters, self.columns_
        parameters.check()
        methods = ("paper",) if self.base_logit_ is None else ("recalibration", "paper")
        method = method or methods[0]
        if method not in methods:
            raise ValueError(
                f"{self._who}: cannot adapt by '{method}'; the methods are {list(methods)}, and "
                "'recalibration' needs maps with heads"
            )
        check_feedback(feedback, self.info_)
        drawn = used_episodes(feedback)
        self.check_unused(*{one.seed for one in drawn}, purpose="adaptation")
        segments = feedback_segments(feedback, parameters)
        adapted = copy.copy(self)
        adapted.parameters = copy.deepcopy(parameters)
        rows = [pair.rows for pair in feedback]
        seen = [columns.of(one.state, one.desired_preview, one.features) for one in rows]
        adapted.novelty_ = self.novelty_.with_feedback(
            np.concatenate(seen), parameters.novelty_rate
        )
        if motions is not None:
            adapted.detector_ = self._detector_with(motions)
        # The thresholds' promises hold for the old beliefs only.
        adapted.calibrations_ = {}
        adapted.used_ = [*(one for one in self.used_ if one.purpose != "adaptation"), *drawn]
        num_causes = len(self.info_.constraint_names)
        if method == "paper" or self.base_logit_ is None:
            x = columns.of(segments.state, segments.desired_preview, segments.features)
            adapted.correction_ = Correction.none(self.embedding_, self.grid_, self.trees_)
            adapted.beliefs_ = adaptation.paper_beliefs(
                self.training_,
                segments,
                self.embedding_.embed(x),
                self.grid_,
                parameters,
                num_causes,
            )
        else:
            adapted.correction_, adapted.beliefs_ = recalibrated_beliefs(
                feedback,
                segments,
                columns=columns,
                embedding=self.embedding_,
                base_logit=self.base_logit_,
                trees=self.trees_,
                training=self.training_,
                grid=self.grid_,
                parameters=parameters,
                num_causes=num_causes,
            )
        adapted.adaptation_ = Adaptation(
            method=method,
            variation=feedback[0].info.variation,
            num_sets=len(feedback),
            num_differing=sum(pair.differs for pair in feedback),
        )
        return adapted

    def _detector_with(self, motions: Episodes | Sequence[np.ndarray]) -> ChangeDetector:
        if not isinstance(motions, Episodes):
            return self.detector_.with_motions(motions)
        found, wanted = motions.info.step_s, self.detector_.step_s
        every = round(wanted / found)
        if not math.isclose(every * found, wanted):
            raise ValueError(
                f"{self._who}: rows of the motions are {found} s apart, which does not divide the "
                f"{wanted} s of the monitor's training"
            )
        return self.detector_.with_motions([rows[::every] for rows in usual_rows(motions)])

    def check_unused(self, *seeds: int, purpose: str = "") -> None:
        """Checks that seeds were not used for training, calibration or adaptation.

        Earlier sets of the ``purpose``, such as "calibration", which these replace, are ignored.
        """
        self._check_fitted()
        used = [one for one in self.used_ if one.purpose != purpose]
        check_unused(used, seeds, self._who)

    def adopt_calibrations(
        self, calibrations: Sequence[Calibration], info: EpisodesInfo, num_episodes: int
    ) -> None:
        """Replaces the calibrations."""
        self.check_unused(info.seed, purpose="calibration")
        kept = [one for one in self.used_ if one.purpose != "calibration"]
        self.calibrations_ = {one.kind: one for one in calibrations}
        self.used_ = [*kept, UsedEpisodes.of("calibration", info, num_episodes)]

    def inputs_of(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """Returns x, (..., n_x); the arguments are those of `predict`."""
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
        *,
        beliefs: np.ndarray | None = None,
        correction: Correction | None = None,
        novelty: Novelty | None = None,
    ) -> Prediction:
        """Assesses N inputs.

        Args:
            state: Measured states, (N, n_s).
            desired_preview: Desired outputs over the horizon, row-major in time, (N, H*n_z).
            features: Features, (N, n_f); ignored in the paper's mode.
            beliefs: Beliefs of the cells; `beliefs_` by default, (K, R*R, 3 + n_c).
            correction: Correction of the base logit; `correction_` by default.
            novelty: Says which inputs are novel; `novelty_` by default.

        Returns:
            The prediction. Novel inputs and those that are not finite get the empty belief, whose
            probability is 0. A row has the same bits whatever the others are.
        """
        self._check_fitted()
        x = self.inputs_of(state, desired_preview, features)
        if x.ndim != 2:
            raise ValueError(
                f"{self._who}: state has the shape {np.shape(state)}, expected (N, n_s); "
                "predict_one assesses a single input"
            )
        return self._predict(x, beliefs, correction, novelty)

    def predict_rows(self, rows: Episode | Segments, variation: str = "nominal") -> Prediction:
        """Assesses recorded rows of a plant.

        In the paper's mode, the states of the nominal plant are without noise.
        """
        self._check_fitted()
        return self._predict(self.columns_.of_rows(rows, variation))

    @one_blas_thread
    def _predict(
        self,
        x: np.ndarray,
        beliefs: np.ndarray | None = None,
        correction: Correction | None = None,
        novelty: Novelty | None = None,
    ) -> Prediction:
        if beliefs is not None or correction is not None:
            beliefs = self.beliefs_ if beliefs is None else beliefs
            correction = self.correction_ if correction is None else correction
            prediction.check_shapes((beliefs, correction), (self.beliefs_, self.correction_))
        return prediction.predict(
            x,
            embedding=self.embedding_,
            grid=self.grid_,
            beliefs=self.beliefs_ if beliefs is None else beliefs,
            correction=self.correction_ if correction is None else correction,
            base_logit=self.base_logit_,
            trees=self.trees_,
            fall_logit=self.fall_logit_,
            novelty=self.novelty_ if novelty is None else novelty,
            initial_uncertainty=self.parameters.initial_uncertainty,
        )

    def predict_one(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        *,
        beliefs: np.ndarray | None = None,
        correction: Correction | None = None,
        novelty: Novelty | None = None,
    ) -> Prediction:
        """Assesses one input; the arguments are those of `predict` without the axis N.

        The result has the same bits as that of `predict` in a row.
        """
        self._check_fitted()
        x = self.inputs_of(state, desired_preview, features)
        if x.ndim != 1:
            raise ValueError(
                f"{self._who}: state has the shape {np.shape(state)}, expected (n_s,); "
                "predict assesses many inputs"
            )
        return self._predict(x[None], beliefs, correction, novelty).one(0)

    def strangest_input(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> tuple[str, float]:
        """Returns the entry of x that contradicts the others most, and by how much.

        It is one of `columns_.names`; the difference from what the others say is in standard
        deviations of training. The arguments are those of `predict_one`.
        """
        self._check_fitted()
        found = self.novelty_.contradictions(self.inputs_of(state, desired_preview, features))
        column = int(np.argmax(np.abs(found)))
        return self.columns_.names[column], float(found[column])

    def unsafe_logits(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns x, the maps' mean logit (N,) of an unsafe end and its gradient, (N, n_x) both.

        The belief is constant where all corners of a cell agree; the safety heads' logit has a
        slope everywhere, for planners that need a gradient. Trees have none: they are left out. The
        arguments are those of `predict`.
        """
        x = self.inputs_of(state, desired_preview, features)
        return x, *self.embedding_.logit_gradient(x)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one safetensors file atomically."""
        self._check_fitted()
        learned = {name: value for name, value in vars(self).items() if name.endswith("_")}
        assessment_file.write(Path(path), self.parameters, learned)

    def to_onnx(self, path: str | os.PathLike[str]) -> None:
        """Writes `predict` as one ONNX graph, atomically; see docs/export.md.

        It is that of the present beliefs, correction and novelty, and its metadata say what its
        inputs are, what its thresholds promise and for which plant.
        """
        from drake_safety.learning import onnx_graph

        self._check_fitted()
        onnx_graph.write(Path(path), self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SafetyAssessment:
        """Reads a file written by `save`."""
        parameters, learned = assessment_file.read(Path(path))
        assessment = cls(parameters)
        vars(assessment).update(learned)
        return assessment
