"""``drake-safety train``: simulates the closed loop of nominal and random plants, trains Γ."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.files.progress import stage_of
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.seeds import FALLS, TRAINING
from drake_safety.learning.segments import Episodes, training_segments
from drake_safety.robots.family import FAMILY
from drake_safety.simulation.capabilities import CanFall, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import completed, load_episodes
from drake_safety.simulation.rollouts import motion_piece_s, run_episodes, run_motions
from drake_safety.simulation.scenario import load_scenario

_WATCHED = 128  # Episodes that the monitor watches too.


def train(
    scenario: console.ScenarioArgument,
    out: Annotated[Path, Option(help="Folder for episodes and assessments.")],
    episodes: Annotated[int, Option(help="Nominal training episodes.", min=1)] = 2048,
    plants: Annotated[
        int | None,
        Option(help="Random plants; by default as many as the scenario's family has.", min=0),
    ] = None,
    seed: Annotated[int, Option(help="Seed of the episodes.")] = TRAINING.first,
    motion: Annotated[
        float | None,
        Option(
            help="Minutes of motion for the monitor; by default 6 s an episode, to 48.", min=0.0
        ),
    ] = None,
    falls: Annotated[
        int | None, Option(help="Episodes until a fall; by default a quarter of the others.", min=0)
    ] = None,
    mode: Annotated[str, Option(help="'sharpened', 'paper' (as published), or 'both'.")] = "both",
    resume: Annotated[bool, Option("--resume", help="Continue with the episodes in OUT.")] = False,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Simulate the closed loop of the nominal and of random plants, and train Γ.

    The scenario's family defines the random plants and their number of episodes; `paper` learns
    from the nominal plant alone. Finished episodes are kept: a stopped run continues with --resume.
    """
    if mode not in (*MODES, "both"):
        raise ValueError(f"train: mode must be one of {[*MODES, 'both']}; got '{mode}'")
    modes = MODES if mode == "both" else (mode,)
    loaded = load_scenario(scenario)
    seeds, family = TRAINING.seeds(seed), loaded.family
    if plants and family is None:
        raise ValueError(f"train: scenario '{loaded.name}' has no `family:` to draw plants of")
    if plants == 0 or MODES[0] not in modes:
        family = None
    num_drawn = round(family.share * episodes) if family else 0
    drawn = folders.family_folder(out)
    # Number and arguments of a set by its folder; modes may share one.
    sets: dict[Path, tuple[int, dict[str, Any]]] = {}
    for name in modes:
        options = {} if name == MODES[0] else loaded.options_for("paper")
        sets[out / (f"episodes_{name}" if options else "episodes")] = episodes, options
    if num_drawn:
        sets[drawn] = num_drawn, {"variation": FAMILY, "plants": plants}
    for folder in sets:
        if not resume and folder.exists() and (kept := completed(folder)):
            raise ValueError(f"{folder} already holds {len(kept)} episodes: pass --resume")
    folders.check_writable(out)
    loop = loaded.make_loop()
    if family is not None:  # What the task does not take is refused before the simulations.
        whole = family.extreme(loaded.variation("nominal"), 0)
        loaded.with_variation(FAMILY, whole).make_loop(FAMILY)
    piece_s = motion_piece_s(loop)
    motion_s = max(min(6.0 * episodes, 2880.0), 2.0 * piece_s) if motion is None else 60.0 * motion
    if 0.0 < motion_s <= piece_s:
        raise ValueError(
            f"train: --motion {motion_s / 60.0:g} is too little: give 2 or more, or 0 for none"
        )
    with console.open_stages() as stages:

        def work(folder: Path, stage: str) -> dict[str, Any]:
            return {"num_workers": workers, "path": folder, "progress": partial(stages, stage)}

        extra = {"command": console.command_line(), "scenario_yaml": loaded.to_yaml()}
        for folder, (number, options) in sets.items():
            options |= work(folder, folder.name) | {"extra": extra}
            its_seed = seeds["training on the family" if folder == drawn else "training"]
            run_episodes(loaded, number, seed=its_seed, **options)
        detector = None
        if motion_s:
            motions = run_motions(loaded, motion_s, **work(out / "motion", "undisturbed motion"))
            options = work(out / "watched", "episodes for the monitor") | {"are_episodes": True}
            watched_s = min(episodes, _WATCHED) * loaded.episode_duration_s
            watched = run_motions(loaded, watched_s, seed=seed, **options)
            # The half of which nothing is learned says what the monitor knows.
            known, fresh = (Episodes(watched.info, list(watched)[i::2]) for i in range(2))
            detector = ChangeDetector.fit(motions, stage_of(stages, "monitor"), episodes=known)
        num_falls = episodes // 4 if falls is None else falls
        fallen = None
        if num_falls and MODES[0] in modes and isinstance(loop, CanFall):
            options = work(out / "falls", "episodes until a fall") | {"until_fall": True}
            fallen = run_episodes(loaded, num_falls, seed=FALLS.first, **options)
        rows = []
        for name in modes:
            started = time.process_time()
            parameters = replace(loaded.assessment, mode=name)  # type: ignore[arg-type]  # Checked.
            data = load_episodes(folders.episodes_folder(out, name))
            on_family = load_episodes(drawn) if name == MODES[0] and num_drawn else None
            # Γ belongs to the scenario's diagram; options of training episodes do not count.
            data.info = replace(data.info, scenario_hash=loaded.simulation_hash())
            gamma = SafetyAssessment(parameters).fit(
                data,
                lambda stage, *counts, name=name: stages(f"{name}: {stage}", *counts),
                family=on_family,
                detector=detector,
            )
            if on_family is not None:
                data = data.joined(on_family)
            if fallen is not None and name == MODES[0]:
                _fit_falls(gamma, fallen, loop)
            gamma.save(folders.assessment_file(out, name))
            num_segments = len(training_segments(data, parameters))
            unsafe = f"{data.num_unsafe} of {len(data)} ({data.num_diverged} diverged)"
            cpu_time = f"{time.process_time() - started:.0f} s"
            rows.append((name, f"{num_segments}", unsafe, cpu_time))
    console.show(console.new_table("mode", "segments", "unsafe episodes", "CPU time", rows=rows))
    console.say(gamma.detector_.describe())
    if detector is not None:
        text, is_ok = detector.describe_alarms(fresh)
        console.say(text, style=None if is_ok else "yellow")
    for folder in sets:
        console.say("episodes  ", folder)
    for name in modes:
        console.say("assessment", folders.assessment_file(out, name))


def _fit_falls(gamma: SafetyAssessment, fallen: Episodes, loop: ClosedLoop) -> None:
    """Fits the probability of a fall to the features that tell of one."""
    if not 0 < fallen.num_unsafe < len(fallen):
        console.say(f"{fallen.num_unsafe} of {len(fallen)} episodes fall: none is learned of")
        return
    watched = require(loop, CanFall).watched_features.values()
    names = fallen.info.feature_names
    used = [one for one in names if one in watched or one.startswith("tracking_error_")]
    gamma.fit_falls(fallen, used)
