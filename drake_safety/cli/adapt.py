"""``drake-safety adapt``: adapts Γ to an actual robot, and evaluates it before and after."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.metrics import Bootstrap, Estimate, mean
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.change_detector import LEAST_MOTION_S
from drake_safety.learning.feedback import EpisodePair
from drake_safety.learning.seeds import ADAPTATION, MOTION
from drake_safety.learning.segments import Episodes
from drake_safety.logs.episodes import cut_log, loggable_loop, motions_from_log
from drake_safety.logs.robot_log import read_pieces
from drake_safety.simulation.feedback import pair_starts, run_pairs
from drake_safety.simulation.rollouts import run_motions
from drake_safety.simulation.scenario import load_scenario

_NUM_FOLDS = 5  # Folds of the feedback; each is judged after adapting to the others.
_MOTION_S = 1.25 * LEAST_MOTION_S  # Motion of a simulated actual plant; some may leave.


def adapt(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    feedback: Annotated[int, Option(help="Actual episodes, with nominal twins.", min=1)] = 160,
    variation: Annotated[str, Option(help="Variation of the actual plant.")] = "actual",
    log: Annotated[
        list[Path] | None,
        Option(help="Log of a robot, in place of a variation; repeatable.", exists=True),
    ] = None,
    log_map: console.MapOption = None,
    out: Annotated[
        Path | None, Option(help="Folder to write; ASSESSMENT/adapted-VARIATION by default.")
    ] = None,
    seed: Annotated[int, Option(help="Seed of the feedback.")] = ADAPTATION.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Adapt Γ to an actual robot, and say whether it is better on episodes or logs held out.

    Other commands take the folder in place of ASSESSMENT. Episodes are kept: a stopped adaptation
    continues when called again.
    """
    loaded = load_scenario(scenario)
    learned = folders.assessment_folder(loaded, assessment)
    priors = {mode: folders.load_assessment(learned.path, mode) for mode in MODES}
    for prior in priors.values():
        folders.check_fresh(prior, loaded)
        prior.check_unused(seed, purpose="adaptation")
    logs = log or []
    if log_map is not None and not logs:
        raise ValueError("adapt: --map needs --log")
    if len({path.resolve() for path in logs}) < len(logs):
        raise ValueError("adapt: logs must differ, as each is judged by the others")
    name = logs[0].stem if logs else variation
    folder = out or learned.out / f"adapted-{name}"
    folders.check_writable(folder)
    with console.open_stages() as stages:
        if logs:
            loop = loggable_loop(loaded)
            pieces, cut = [], []
            for path in logs:
                read = read_pieces(path, log_map, loop.robot)
                if summary := read.summary():
                    console.say(summary, style="yellow")
                pieces += read.pieces
                cut.append(cut_log(read.pieces, loop))
            episodes = chain.from_iterable(episodes for episodes, _ in cut)
            numbered = [replace(episode, index=i) for i, episode in enumerate(episodes)]
            starts = [*chain.from_iterable(starts for _, starts in cut)]
            pairs = pair_starts(loaded, Episodes(cut[0][0].info, numbered), starts, seed=seed)
            motions = motions_from_log(pieces, loop, step_s=priors[MODES[0]].detector_.step_s)
        else:
            kept = folders.feedback_options(loaded, learned.out, variation, seed, workers)
            report = partial(stages, "actual episodes and their twins")
            pairs = run_pairs(loaded, feedback, seed=seed, progress=report, **kept)
            kept |= {"path": kept["path"] / "motion"}
            report = partial(stages, "undisturbed actual motion")
            drawn = MOTION.seeds()["motion of the actual robot"]
            motions = run_motions(loaded, _MOTION_S, seed=drawn, progress=report, **kept)
        sets = pairs.feedback()
        held, unit = "parts of the log" if logs else "episodes", np.arange(len(pairs.actual))
        if len(logs) > 1:
            held, unit = "logs", np.repeat(range(len(logs)), [len(episodes) for episodes, _ in cut])
        units = unit[[pair.actual.index for pair in sets]]
        adapted = {mode: prior.adapt(sets, motions=motions) for mode, prior in priors.items()}
        folder.mkdir(parents=True, exist_ok=True)
        for mode, gamma in adapted.items():
            gamma.save(folders.assessment_file(folder, mode))
        scores = {mode: _held_out(prior, sets, units) for mode, prior in priors.items()}
    num_differing = sum(pair.differs for pair in sets)
    entries = {
        "scenario_hash": pairs.actual.info.scenario_hash,
        "nominal_hash": pairs.nominal.info.scenario_hash,
        "variation": name,
        "logs": [str(path) for path in logs],
        "seed": seed,
        "feedback_sets": len(sets),
        "differing_pairs": num_differing,
        "change": {mode: gamma.correction_.change.tolist() for mode, gamma in adapted.items()},
        "monitor": adapted[MODES[0]].detector_.describe(),
    }
    figures = {("held_out", m, metric): one for m in MODES for metric, one in scores[m].items()}
    Results(figures, console.made_by(loaded.name) | entries).write(folder / "adaptation.json")
    console.say(f"adapted to '{name}': {num_differing} of {len(sets)} pairs end differently")
    console.say(adapted[MODES[0]].detector_.describe())
    for mode in MODES:
        console.say(f"{mode}: {_summary(scores[mode], held)}")
        console.say("assessment", folders.assessment_file(folder, mode))
    console.say("figures   ", folder / "adaptation.json")


def _held_out(
    prior: SafetyAssessment, pairs: list[EpisodePair], units: np.ndarray
) -> dict[str, Estimate]:
    """Brier scores before and after adapting to other units (N,), logs or pairs; none of one."""
    folds, errors = np.unique(units, return_inverse=True)[1] % _NUM_FOLDS, []
    for fold in range(folds.max() + 1 if folds.any() else 0):
        adapted = prior.adapt([pairs[i] for i in np.flatnonzero(folds != fold)])
        for i in np.flatnonzero(folds == fold):
            rows, variation = pairs[i].rows, pairs[i].info.variation
            before, after = (
                (assessment.predict_rows(rows, variation).probability - ~rows.is_unsafe) ** 2
                for assessment in (prior, adapted)
            )
            errors.append(np.array([before, after, after - before, np.full(len(rows), units[i])]))
    if not errors:
        return {}
    *columns, unit = np.concatenate(errors, axis=1)
    means = [mean(column, unit, bootstrap=Bootstrap()) for column in columns]
    return dict(zip(("before", "after", "change"), means, strict=True))


def _summary(scores: Mapping[str, Estimate], held: str) -> str:
    """Whether Γ gets better on what it was not adapted to."""
    if not scores:
        return "only one pair: nothing is held out to judge the adaptation"
    before, after, change = scores.values()
    verdict = "no clear change"
    if change.n < _NUM_FOLDS:
        verdict = "too few to tell"
    elif change.low > 0 or change.high < 0:
        verdict = "worse" if change.low > 0 else "better"
    return (
        f"{verdict} on {change.n} held-out {held}: Brier score {before.value:.3f} before, "
        f"{after.value:.3f} after, {change.value:+.3f} ({change.low:+.3f} to {change.high:+.3f})"
    )
