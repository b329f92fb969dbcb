"""The safety assessment function Γ: how likely the closed loop stays safe."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.progress import StageProgress, shown
from drake_safety.learning import adaptation, assessment_file, prediction, recalibration
from drake_safety.learning.adaptation import Adaptation, TrainingScores
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.blas_threads import one_blas_thread
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.change_detector import ChangeDetector, usual_rows
from drake_safety.learning.feedback import (
    FeedbackSegments,
    FeedbackSet,
    check_feedback,
    segments_of,
    used_episodes,
)
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import input_names, inputs, plan_columns, used_states
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.prediction import Assessment, Assessments, BaseLogit, Correction
from drake_safety.learning.seeds import UsedEpisodes, check_unused
from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo, split
from drake_safety.learning.training import check_preview, known_range, learned_maps, segments_for

__all__ = [
    "AdaptationParameters",
    "Assessment",
    "AssessmentParameters",
    "Assessments",
    "SafetyAssessment",
]


class SafetyAssessment:
    """Γ: maps the state and the desired preview to a belief about safety.

    `fit` learns it from nominal episodes. Learned attributes end in an underscore:

    - `info_`: the `EpisodesInfo` of the training episodes.
    - `grid_`: the `Grid` of the embedding space.
    - `embedding_`: the maps Psi, an immutable `Embedding`.
    - `detector_`: the `ChangeDetector`, which sees a changed plant or sensor, for a monitor.
    - `beliefs_`: the beliefs of every map's cells, (K, R*R, 3 + n_c). They may be replaced, and
      predictions take other beliefs as an argument.
    - `training_`: the `TrainingScores`, the embedded training segments, from which adaptation
      starts; crowded cells keep some of their segments.
    - `novelty_`: the `Novelty`, which says which inputs are unlike those of training.
    - `base_logit_`: the `BaseLogit`, which scales the maps' heads to one logit; None without heads.
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

    def __init__(self, parameters: AssessmentParameters | None = None):
        # A copy, so that later changes of a scenario do not change a trained assessment.
        self.parameters = copy.deepcopy(parameters or AssessmentParameters())

    def __repr__(self) -> str:
        mode = f"mode '{self.parameters.mode}'"
        if not hasattr(self, "beliefs_"):
            return f"SafetyAssessment({mode}, not fitted)"
        words = [f"'{self.info_.scenario}'", mode, f"{len(self.beliefs_)} maps"]
        for one in self.used_:
            count = "" if one.num_episodes is None else f"{one.num_episodes} "
            words.append(f"{one.purpose} on {count}episodes of '{one.variation}'")
        return f"SafetyAssessment({', '.join(words)})"

    @property
    def uses_features(self) -> bool:
        """Whether x contains the features, as in the sharpened mode."""
        return self.parameters.is_sharpened

    @property
    def num_causes(self) -> int:
        """n_c, the number of constraints."""
        return len(self.info_.constraint_names)

    def fit(
        self,
        episodes: Episodes,
        progress: StageProgress | bool | None = None,
        *,
        detector: ChangeDetector | None = None,
    ) -> SafetyAssessment:
        """Learns embedding and beliefs from nominal episodes.

        Args:
            progress: Called with a stage ("distances", "t-SNE", "training", "monitor",
                "beliefs"), the percentage done and 100; True shows it.
            detector: That of undisturbed motion. By default it is learned from the episodes, whose
                motion rarely suffices for its limits.

        Raises:
            MissingExtraError: The extra "train" is not installed.
            ValueError: A parameter is invalid, the horizons differ, or there are too few segments.
        """
        require_extra("train", "SafetyAssessment.fit")
        self.parameters.check()
        from threadpoolctl import threadpool_limits

        # The order of sums depends on the number of threads, and the last bits with it.
        with (
            threadpool_limits(1, user_api="blas"),
            shown(progress, lambda stages: stages) as report,
        ):
            self._learn(episodes, report, detector)
        return self

    def _learn(
        self,
        episodes: Episodes,
        progress: StageProgress | None,
        detector: ChangeDetector | None,
    ) -> None:
        parameters = self.parameters
        info = episodes.info
        check_preview(info, parameters)
        segments, has_target = segments_for(episodes, parameters)
        self.info_ = info
        self.grid_ = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
        x = self.inputs_of(
            segments.state if parameters.is_sharpened else segments.true_state,
            segments.desired_preview,
            segments.features if parameters.is_sharpened else None,
        )
        self.embedding_, base_logit = learned_maps(
            segments, has_target, x, self.grid_, parameters, progress
        )
        if parameters.is_sharpened:
            self.embedding_ = self.embedding_.clipping(known_range(x))
        every = split(episodes, stride=1, discount=1.0, shortest=1)
        self.novelty_ = Novelty.fit(
            # With noise in either mode, as on a robot.
            self.inputs_of(every.state, every.desired_preview, every.features),
            every.episode,
            every.is_unsafe,
            parameters.novelty_rate,
            plan=plan_columns(info, parameters),
        )
        self.detector_ = ChangeDetector.fit(episodes) if detector is None else detector
        if progress is not None:
            progress("monitor", 100, 100)
        output = self.embedding_.evaluate(x)
        self.base_logit_: BaseLogit | None = base_logit
        self.training_ = TrainingScores.of(segments, output, base_logit).thinned(
            self.grid_, parameters.seed
        )
        self.adaptation_: Adaptation | None = None
        self.calibrations_: dict[str, Calibration] = {}
        self.used_ = [UsedEpisodes.of("training", info, len(episodes))]
        self.correction_ = Correction.none(self.embedding_, self.grid_)
        self.beliefs_ = adaptation.prior_beliefs(
            self.training_, self.grid_, parameters, self.num_causes
        )
        if progress is not None:
            progress("beliefs", 100, 100)

    def prior_beliefs(self) -> np.ndarray:
        """Computes the beliefs of every map's cells before any feedback, (K, R*R, 3 + n_c)."""
        self._check_fitted()
        return adaptation.prior_beliefs(
            self.training_, self.grid_, self.parameters, self.num_causes
        )

    def adapt(
        self,
        feedback: Sequence[FeedbackSet],
        *,
        method: str | None = None,
        motions: Episodes | Sequence[np.ndarray] | None = None,
    ) -> SafetyAssessment:
        """Returns a copy adapted to feedback from the actual robot.

        Every adaptation starts from the nominal episodes, as F is not associative: pass all
        feedback, not only the new sets.

        Departure ("recalibration"): see `recalibration.recalibrated_beliefs`.

        Args:
            method: "recalibration" corrects the base logit and with it the training scores;
                "paper" is the paper's update by a discrepancy function and feedback beliefs.
                Default: "recalibration" for maps with heads, else "paper".
            motions: Motion of the actual robot that the monitor is to know as well, or its rows
                (state, desired preview, features), (K, n) each, as far apart as in its training;
                of motion with more rows those between are left out.

        Raises:
            MissingExtraError: The extra "train" is not installed.
            ValueError: Unknown method, maps without heads for "recalibration", no feedback, or
                feedback of another scenario.
        """
        require_extra("train", "SafetyAssessment.adapt", "sklearn")
        self._check_fitted()
        self.parameters.check()
        who = f"SafetyAssessment of '{self.info_.scenario}'"
        method = adaptation.chosen_method(method, has_heads=self.base_logit_ is not None, who=who)
        check_feedback(feedback, self.info_)
        drawn = used_episodes(feedback)
        self.check_unused(*{one.seed for one in drawn}, purpose="adaptation")
        segments = self.feedback_segments(feedback)
        x = self.inputs_of(segments.state, segments.desired_preview, segments.features)
        points = self.embedding_.embed(x)
        adapted = copy.copy(self)
        rows = [self._rows(one) for one in feedback]
        adapted.novelty_ = self.novelty_.with_feedback(
            np.concatenate(rows), self.parameters.novelty_rate
        )
        if motions is not None:
            adapted.detector_ = self._detector_with(motions)
        adapted.parameters = copy.deepcopy(self.parameters)
        # The thresholds' promises hold for the old beliefs only.
        adapted.calibrations_ = {}
        adapted.used_ = [*(one for one in self.used_ if one.purpose != "adaptation"), *drawn]
        adapted.correction_ = Correction.none(self.embedding_, self.grid_)
        if method == "paper":
            adapted.beliefs_ = adaptation.paper_beliefs(
                self.training_, segments, points, self.grid_, self.parameters, self.num_causes
            )
        elif self.base_logit_ is not None:
            adapted.correction_, adapted.beliefs_ = recalibration.recalibrated(
                feedback,
                segments,
                x,
                points,
                inputs=self.inputs_of,
                embedding=self.embedding_,
                base_logit=self.base_logit_,
                training=self.training_,
                grid=self.grid_,
                parameters=self.parameters,
                num_causes=self.num_causes,
            )
        adapted.adaptation_ = Adaptation(
            method=method,
            variation=feedback[0].info.variation,
            num_sets=len(feedback),
            num_differing=sum(one.differs for one in feedback),
        )
        return adapted

    def _detector_with(self, motions: Episodes | Sequence[np.ndarray]) -> ChangeDetector:
        if not isinstance(motions, Episodes):
            return self.detector_.with_motions(motions)
        found, wanted = motions.info.step_s, self.detector_.step_s
        every = round(wanted / found)
        if not math.isclose(every * found, wanted):
            raise ValueError(
                f"SafetyAssessment of '{self.info_.scenario}': rows of the motions are {found} s "
                f"apart, which does not divide the {wanted} s of the monitor's training"
            )
        return self.detector_.with_motions([rows[::every] for rows in usual_rows(motions)])

    def check_unused(self, *seeds: int, purpose: str = "") -> None:
        """Checks that seeds were not used for training, calibration or adaptation.

        Args:
            purpose: "calibration" or "adaptation" if the sets replace those of an earlier one,
                which are then ignored; the default is evaluation.

        Raises:
            ValueError: A seed was used; the message names its purpose and a free seed.
        """
        self._check_fitted()
        used = [one for one in self.used_ if one.purpose != purpose]
        check_unused(used, seeds, f"SafetyAssessment of '{self.info_.scenario}'")

    def adopt_calibrations(
        self, calibrations: Sequence[Calibration], info: EpisodesInfo, num_episodes: int
    ) -> None:
        """Replaces the calibrations.

        Raises:
            ValueError: The episodes were used for training or adaptation.
        """
        self.check_unused(info.seed, purpose="calibration")
        kept = [one for one in self.used_ if one.purpose != "calibration"]
        self.calibrations_ = {one.kind: one for one in calibrations}
        self.used_ = [*kept, UsedEpisodes.of("calibration", info, num_episodes)]

    def feedback_segments(self, feedback: Sequence[FeedbackSet]) -> FeedbackSegments:
        """Splits feedback sets into segments as the training episodes were split."""
        parameters = self.parameters
        return segments_of(
            feedback,
            stride=parameters.stride,
            shortest=parameters.shortest,
            discount=parameters.discount,
            plain=not parameters.is_sharpened,
        )

    def _rows(self, motion: Episode | FeedbackSet) -> np.ndarray:
        return self.inputs_of(motion.state, motion.desired_preview, motion.features)

    @property
    def state_names(self) -> list[str]:
        """Names of the states in x, which are its first columns."""
        is_used = used_states(self.info_, self.parameters)
        return [n for n, used in zip(self.info_.state_names, is_used, strict=True) if used]

    def inputs_of(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """Returns x, (..., n_x); the arguments are those of `predict`."""
        return inputs(state, desired_preview, features, self.info_, self.parameters)

    def _check_fitted(self) -> None:
        if not hasattr(self, "beliefs_"):
            raise ValueError("SafetyAssessment: not fitted or loaded yet")

    def _or_own(
        self, beliefs: np.ndarray | None, correction: Correction | None
    ) -> tuple[np.ndarray, Correction]:
        if beliefs is None and correction is None:
            return self.beliefs_, self.correction_
        beliefs = self.beliefs_ if beliefs is None else beliefs
        correction = self.correction_ if correction is None else correction
        prediction.check_shapes((beliefs, correction), (self.beliefs_, self.correction_))
        return beliefs, correction

    def predict(
        self,
        state: np.ndarray,
        desired_preview: np.ndarray,
        features: np.ndarray | None = None,
        *,
        beliefs: np.ndarray | None = None,
        correction: Correction | None = None,
        novelty: Novelty | None = None,
    ) -> Assessments:
        """Assesses N inputs.

        Args:
            state: Measured states, (N, n_s).
            desired_preview: Desired outputs over the horizon, row-major in time, (N, H*n_z).
            features: Features, (N, n_f); ignored in the paper's mode.
            beliefs: Beliefs of the cells; `beliefs_` by default, (K, R*R, 3 + n_c).
            correction: Correction of the base logit; `correction_` by default.
            novelty: Says which inputs are novel; `novelty_` by default.

        Returns:
            The assessments. Novel inputs and those that are not finite get the empty belief, whose
            probability is 0. A row has the same bits whatever the others are.

        Raises:
            ValueError: A width or a shape is wrong, or the assessment is not fitted.
        """
        self._check_fitted()
        x = self.inputs_of(state, desired_preview, features)
        if x.ndim != 2:
            raise ValueError(
                f"SafetyAssessment of '{self.info_.scenario}': state has the shape "
                f"{np.shape(state)}, expected (N, n_s); predict_one assesses a single input"
            )
        return self._predict(x, beliefs, correction, novelty)

    @one_blas_thread
    def _predict(
        self,
        x: np.ndarray,
        beliefs: np.ndarray | None,
        correction: Correction | None,
        novelty: Novelty | None,
    ) -> Assessments:
        beliefs, correction = self._or_own(beliefs, correction)
        return prediction.predict(
            x,
            embedding=self.embedding_,
            grid=self.grid_,
            beliefs=beliefs,
            correction=correction,
            base_logit=self.base_logit_,
            novelty=self.novelty_ if novelty is None else novelty,
            initial_uncertainty=self.parameters.initial_uncertainty,
            is_sharpened=self.parameters.is_sharpened,
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
    ) -> Assessment:
        """Assesses one input; the arguments are those of `predict` without the axis N.

        The result has the same bits as that of `predict` in a row.
        """
        self._check_fitted()
        x = self.inputs_of(state, desired_preview, features)
        if x.ndim != 1:
            raise ValueError(
                f"SafetyAssessment of '{self.info_.scenario}': state has the shape "
                f"{np.shape(state)}, expected (n_s,); predict assesses many inputs"
            )
        return self._predict(x[None], beliefs, correction, novelty).one(0)

    def strangest_input(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> tuple[str, float]:
        """Returns the entry of x that contradicts the others most, and by how much.

        The arguments are those of `predict_one`.

        Returns:
            Its name, as in `inputs.input_names`, and the difference from what the other entries
            say, in standard deviations of training.
        """
        self._check_fitted()
        found = self.novelty_.contradictions(self.inputs_of(state, desired_preview, features))
        column = int(np.argmax(np.abs(found)))
        return input_names(self.info_, self.parameters)[column], float(found[column])

    def unsafe_logits(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the mean logit of an unsafe end and its gradient with respect to x.

        The belief is constant where all corners of a cell agree; the safety heads' logit has a
        slope everywhere, for planners that need a gradient. The arguments are those of `predict`.

        Returns:
            x (N, n_x), the logit (N,) and its gradient (N, n_x).

        Raises:
            ValueError: The maps have no safety head, as in the paper's mode.
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

        Raises:
            MissingExtraError: The extra "onnx" is not installed.
            ValueError: The assessment is not fitted.
        """
        from drake_safety.learning import onnx_graph

        self._check_fitted()
        onnx_graph.write(Path(path), self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SafetyAssessment:
        """Reads a file written by `save`.

        Raises:
            ValueError: The file is truncated, not an assessment, or of another schema version.
        """
        parameters, learned = assessment_file.read(Path(path))
        assessment = cls(parameters)
        vars(assessment).update(learned)
        return assessment
