"""``drake-safety calibrate``: thresholds of Γ with a promised miss rate, stored with Γ."""

from functools import partial
from typing import Annotated

from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.figure_style import label_of
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.calibration import KINDS, check_share, episode_scores
from drake_safety.learning.calibration import calibrate as choose
from drake_safety.learning.seeds import CALIBRATION, NOT_DRAWN
from drake_safety.learning.segments import joined, split
from drake_safety.robots.family import FAMILY
from drake_safety.simulation.scenario import load_scenario


def calibrate(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    miss_rate: Annotated[
        float, Option(help="Promised share of unsafe episodes called safe.")
    ] = 0.01,
    false_alarm_rate: Annotated[float, Option(help="Share of safe episodes called unsafe.")] = 0.05,
    confidence: Annotated[
        float | None, Option(help="Confidence of the promise, such as 0.95; on average by default.")
    ] = None,
    episodes: Annotated[int, Option(help="Fresh episodes.", min=2)] = 1000,
    variation: Annotated[
        str | None, Option(help="Plant of the promise; by default that of `adapt`, else nominal.")
    ] = None,
    seed: Annotated[int, Option(help="Seed of the episodes.")] = CALIBRATION.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Choose the temperature, and thresholds with a promised miss rate, on fresh episodes.

    The promise holds for the plant of the episodes: calibrate again after `adapt`. Γ of a family
    gets a second promise over the family's plants, a fresh one for each episode. Episodes are kept
    in ASSESSMENT: a stopped calibration continues, and another promise reuses them.
    """
    check_share("--miss-rate", miss_rate)
    check_share("--false-alarm-rate", false_alarm_rate)
    if confidence is not None:
        check_share("--confidence", confidence)
    loaded = load_scenario(scenario)
    folder = folders.assessment_folder(loaded, assessment)
    learned = folders.load_assessments(folder.path)
    adaptation = learned[MODES[0]].adaptation_
    plant = variation or ("nominal" if adaptation is None else adaptation.variation)
    drawn = [one.seed for one in learned[MODES[0]].used_ if one.purpose == "adaptation"]
    if (is_of_logs := NOT_DRAWN in drawn) and variation is None:
        raise ValueError(
            f"calibrate: no plant simulates the robot of the logs that '{folder.path}' is adapted "
            f"to: a promise holds for a simulated plant, --variation {plant}"
        )
    seeds = {plant: seed}  # By plant.
    if plant == "nominal" and learned[MODES[0]].knows_family:
        seeds[FAMILY] = CALIBRATION.seeds(seed)["calibration over the family"]
    for gamma in learned.values():
        folders.check_fresh(gamma, loaded)
        gamma.check_unused(*seeds.values(), purpose="calibration")
    folders.check_writable(folder.out)
    fresh = {}
    with console.open_stages() as stages:
        for name, its_seed in seeds.items():
            progress = partial(stages, f"{name} calibration episodes")
            options = loaded.options_for("pairs", name)
            if name == FAMILY:
                options["plants"] = episodes
            fresh[name] = folders.run_fresh_episodes(
                loaded, folder.out, episodes, its_seed, progress, workers, name, **options
            )
    segments = {name: split(one, stride=1, discount=1.0, shortest=1) for name, one in fresh.items()}
    rows = []
    for mode, gamma in learned.items():
        sets = {name: fresh[name] for name in seeds if name != FAMILY or gamma.knows_family}
        temperature = gamma.temper(joined([segments[name] for name in sets]))
        chosen = []
        for name, one_set in sets.items():
            score = assessment_scorer(mode, gamma).unsafe_score(segments[name])
            chosen += [
                choose(
                    *episode_scores(segments[name], score, kind),
                    kind=kind,
                    miss_rate=miss_rate,
                    false_alarm_rate=false_alarm_rate,
                    confidence=confidence,
                    seed=one_set.info.seed,
                    scenario_hash=loaded.simulation_hash(name),
                    variation=f"simulated {name}" if is_of_logs else name,
                    plants=one_set.info.plants,
                )
                for kind in KINDS
            ]
        gamma.adopt_calibrations(chosen, *sets.values())
        for one in chosen:
            thresholds = f"{one.threshold:.4f}", f"{one.unsafe_below:.4f}"
            missed = f"{one.num_missed} of {one.num_unsafe}"
            score_name = label_of(f"{mode}.{one.kind}")
            rows.append((score_name, one.variation, *thresholds, missed, f"{temperature:.2f}"))
    for mode, gamma in learned.items():
        gamma.save(folders.assessment_file(folder.out, mode))
    columns = ("score", "plant", "safe from probability", "unsafe below", "misses", "temperature")
    console.show(console.new_table(*columns, rows=rows))
    for promise in dict.fromkeys(one.promise for one in learned[MODES[0]].calibrations_.values()):
        console.say("promised  ", promise)
    for mode in learned:
        console.say("calibrated", folders.assessment_file(folder.out, mode))
