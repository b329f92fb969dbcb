"""``python -m studies ablate``: variants of Γ, each trained with one choice changed.

All learn from the same episodes and are judged at the same rows of the same fresh ones.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption, versions
from drake_safety.cli.training_folder import MODES, episodes_folder
from drake_safety.evaluation.metrics import (
    Bootstrap,
    Estimate,
    auc,
    segment_estimates,
    threshold_at,
)
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.inputs import is_rate
from drake_safety.learning.mode_settings import mode_settings
from drake_safety.learning.seeds import EVALUATION
from drake_safety.learning.segments import Episodes, Segments, split
from drake_safety.simulation.dataset import load_episodes
from studies.baselines import auc_difference
from studies.harness import (
    Arrays,
    CalibrationOption,
    EpisodesOption,
    ReleaseOption,
    SeedOption,
    fingerprint,
    kept,
    open_study,
)

BASELINE = "baseline"
_SCORE_WEIGHTS = (0.0, 0.001, 0.01, 0.1, 0.3)
_PERPLEXITIES = (10.0, 30.0, 60.0)
_RESOLUTIONS = (7, 14, 20, 28, 40)
_MIN_COUNTS = (1, 5, 20, 50)
_HORIZON_SHARES = (0.2, 0.5)
_EPISODE_SHARES = (0.125, 0.25, 0.5)


def ablate(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: EpisodesOption = 1000,
    calibration_episodes: CalibrationOption = 300,
    only: Annotated[str, typer.Option(help="Part of the names of the variants.")] = "",
    seed: SeedOption = EVALUATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Train Γ with one choice changed at a time, and evaluate it on the same episodes.

    Every variant learns from the training episodes in ASSESSMENT. Their scores are kept there: a
    stopped ablation continues. Writes ASSESSMENT/ablation.json and its plot.
    """
    with open_study(
        "ablation",
        scenario,
        assessment,
        seed=seed,
        release=release,
        workers=workers,
        plotted=lambda row: row.metric in ("auc", "brier", "auc_gain"),
    ) as study:
        base = study.load(MODES[0]).parameters
        training = load_episodes(episodes_folder(assessment))
        test, calibration = study.fresh(episodes), study.fresh(calibration_episodes, "thresholds")
        states = training.info.state_names
        of_legs = getattr(study.scenario.make_loop(), "rate_features", [])
        rates = [*filter(is_rate, states), *of_legs]
        variants = list_variants(base, len(training), state_names=states, rate_names=rates)
        variants = [one for one in variants if only in one.name or one.name == BASELINE]
        sets = (training, calibration, test)
        of_all = [base, *((one.info, len(one)) for one in sets), versions()]
        names = {one.name: f"{one.name}-{fingerprint(one, *of_all)}" for one in variants}
        scores = kept(
            assessment / "ablation",
            {names[one.name]: (one, base, *sets) for one in variants},
            unsafe_scores,
            workers=workers,
            progress=partial(study.stages, "variants"),
        )
        found = {name: scores[file] for name, file in names.items()}
        failed = {n: str(one["failed"]) for n, one in found.items() if "failed" in one}
        study.entries |= {"training_episodes": len(training), "left_out": failed}
        judged = [judged_segments(one, base) for one in sets[1:]]
        for name, one in found.items():
            if name not in failed:
                for set_, estimates in variant_estimates(one, found[BASELINE], *judged).items():
                    study.add(f"{set_}.{name}", estimates)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A variant with one choice changed.

    Attributes:
        name: Its key.
        changes: Parameters that differ from those of the baseline.
        num_episodes: Number of training episodes; None for all.
        without: Omitted states and features.
    """

    name: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    num_episodes: int | None = None
    without: Sequence[str] = ()

    def parameters(self, base: AssessmentParameters) -> AssessmentParameters:
        """The parameters of the baseline with the changes."""
        return replace(copy.deepcopy(base), **self.changes)

    def recut(self, episodes: Episodes, horizon: int) -> Episodes:
        """The episodes with the inputs of the variant.

        A shorter horizon uses the beginning of the recorded preview.

        Args:
            episodes: The recorded episodes.
            horizon: Horizon of the variant, at most the recorded one.
        """
        info = episodes.info
        states = _kept_columns(info.state_names, self.without)
        features = _kept_columns(info.feature_names, self.without)
        num_preview = horizon * len(info.output_names)
        return Episodes(
            replace(
                info,
                horizon=horizon,
                state_names=[info.state_names[i] for i in states],
                feature_names=[info.feature_names[i] for i in features],
            ),
            [
                replace(
                    episode,
                    state=episode.state[:, states],
                    true_state=episode.true_state[:, states],
                    features=episode.features[:, features],
                    desired_preview=episode.desired_preview[:, :num_preview],
                )
                for episode in episodes
            ],
        )


def _kept_columns(names: Sequence[str], without: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if name not in without]


def list_variants(
    base: AssessmentParameters,
    num_episodes: int,
    *,
    state_names: Sequence[str],
    rate_names: Sequence[str],
) -> list[Variant]:
    """The variants, the baseline first.

    Args:
        base: Parameters of the baseline.
        num_episodes: Number of training episodes.
        state_names: Columns of the state.
        rate_names: States and features that depend on velocities; without any, no variant omits
            them.
    """
    found = [Variant(name=BASELINE)]

    def vary(name: str, values: Sequence[Any], **more: Sequence[Any]) -> None:
        for i, value in enumerate(values):
            if value != getattr(base, name):
                changes = {name: value, **{key: one[i] for key, one in more.items()}}
                found.append(Variant(name=f"{name} {value:g}", changes=changes))

    vary("score_weight", _SCORE_WEIGHTS)
    # Longer horizons need a longer recorded preview.
    horizons = [max(1, round(share * base.horizon)) for share in _HORIZON_SHARES]
    vary("horizon", horizons, shortest_segment=[min(base.shortest_segment, h) for h in horizons])
    vary("perplexity", _PERPLEXITIES)
    width = base.resolution * base.cell_length
    vary("resolution", _RESOLUTIONS, cell_length=[width / n for n in _RESOLUTIONS])
    vary("min_count", _MIN_COUNTS)
    counts = (round(share * num_episodes) for share in _EPISODE_SHARES)
    found += [Variant(name=f"episodes {n}", num_episodes=n) for n in counts if n]
    rates = [name for name in rate_names if name in state_names]
    if rates:
        found.append(Variant(name="state_without_velocities", without=rates))
        if len(rates) < len(rate_names):
            found.append(Variant(name="without_velocities", without=list(rate_names)))
    if base.mode == "sharpened":
        found.append(Variant(name="paper", changes={"mode": "paper"}))
        # The paper's mode depends strongly on its score weight.
        changes = {"mode": "paper", "score_weight": 0.1}
        found.append(Variant(name="paper score_weight 0.1", changes=changes))
    return found


def unsafe_scores(
    variant: Variant,
    base: AssessmentParameters,
    training: Episodes,
    calibration: Episodes,
    test: Episodes,
) -> Arrays:
    """Trains a variant and scores the fresh segments.

    Returns:
        "calibration" and "test", 1 - the safe share of their segments' beliefs, and "calibrated",
        1 - the probability of those of the test; or "failed", why it cannot be trained.
    """
    parameters = variant.parameters(base)
    recut = variant.recut(training[: variant.num_episodes], parameters.horizon)
    try:
        assessment = SafetyAssessment(parameters).fit(recut)
    except ValueError as error:
        return {"failed": np.array(str(error))}
    found = []
    for episodes in (calibration, test):
        # All variants are evaluated at the rows of the baseline.
        segments = judged_segments(episodes, base)
        info = episodes.info
        states = _kept_columns(info.state_names, variant.without)
        features = _kept_columns(info.feature_names, variant.without)
        state = segments.true_state if assessment.settings.uses_true_state else segments.state
        result = assessment.predict(
            state[:, states],
            segments.desired_preview[:, : parameters.horizon * len(info.output_names)],
            segments.features[:, features],
        )
        found.append(result)
    seen, judged = found
    return {
        "calibration": 1.0 - safe_share(seen.belief),
        "test": 1.0 - safe_share(judged.belief),
        "calibrated": 1.0 - judged.probability,
    }


def judged_segments(episodes: Episodes, base: AssessmentParameters) -> Segments:
    """The segments of fresh episodes at which all variants are evaluated."""
    return split(episodes, stride=1, discount=1.0, shortest=mode_settings(base).shortest)


def variant_estimates(
    scores: Mapping[str, np.ndarray],
    baseline: Mapping[str, np.ndarray],
    calibration: Segments,
    test: Segments,
    *,
    bootstrap: Bootstrap | None = None,
) -> dict[str, dict[str, Estimate]]:
    """Estimates of a variant, and of its gain over the baseline.

    Args:
        scores: What `unsafe_scores` returns.
        baseline: The same of the baseline.
        calibration: The segments for thresholds.
        test: The evaluated segments.
        bootstrap: Settings of the intervals.

    Returns:
        `auc`, `safe_recall`, `unsafe_recall`, `brier`, `auc_gain` and `calibrated_auc` by set, of
        every segment ("segments") and of the first of each episode ("k0"). Recalls are at the
        threshold of best balanced accuracy.
    """
    bootstrap = bootstrap or Bootstrap()
    rows_of = {
        "segments": (np.ones(len(test), dtype=bool), np.ones(len(calibration), dtype=bool)),
        "k0": (test.is_first, calibration.is_first),
    }
    found = {}
    for set_, (rows, seen) in rows_of.items():
        threshold = threshold_at(scores["calibration"][seen], calibration.is_unsafe[seen])
        judged, score = test.take(rows), scores["test"][rows]
        truth = (judged.is_unsafe, judged.episode)
        found[set_] = {
            **segment_estimates(judged, score, threshold=threshold, bootstrap=bootstrap),
            "auc_gain": auc_difference(score, baseline["test"][rows], *truth, bootstrap=bootstrap),
            "calibrated_auc": auc(scores["calibrated"][rows], *truth, bootstrap=bootstrap),
        }
    return found
