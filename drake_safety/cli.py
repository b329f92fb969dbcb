"""The command ``drake-safety``: train, run and evaluate safety assessments."""

from __future__ import annotations

import contextlib
import json
import logging
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table

if TYPE_CHECKING:
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.balls import Throw
    from drake_safety.simulation.scenario import Scenario
    from drake_safety.simulation.throws import ThrowLog

app = typer.Typer(
    help="Learn from simulations how safe a robot's motion is, and ask before and while it moves.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    pretty_exceptions_enable=False,
)
# Square brackets are units here, not markup. A log has no width of its own.
console = Console(markup=False, width=None if sys.stdout.isatty() else 120)
_MODES = ("sharpened", "paper")

ScenarioArgument = Annotated[
    str,
    typer.Argument(help="Name of a scenario (see `scenarios`), or the path of your own YAML file."),
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", help="Worker processes; one a core by default.")
]
AssessmentOption = Annotated[
    Path, typer.Option("--assessment", help="Folder that `train` wrote.", file_okay=False)
]


def _table(*columns: str, title: str | None = None) -> Table:
    """A table whose cells fold where they do not fit: no figure is cut short."""
    return Table(*(Column(name, overflow="fold") for name in columns), title=title)


class _Stages:
    """Progress bars, one a stage, that show the time left."""

    def __init__(self, progress: Progress):
        self._progress = progress
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, done: float, total: float) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._progress.update(self._tasks[stage], completed=done, total=total)


@contextlib.contextmanager
def _stages() -> Iterator[_Stages]:
    columns = (
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        yield _Stages(progress)


@app.command()
def scenarios() -> None:
    """List the scenarios that come with the package."""
    from drake_safety.simulation.scenario import load_scenario, scenario_names

    table = _table("scenario", "task", "robot", "plants", "horizon")
    for name in scenario_names():
        scenario = load_scenario(name)
        horizon_s = scenario.assessment.horizon * scenario.step_s
        table.add_row(
            name,
            scenario.task.rpartition(":")[2],
            scenario.robot,
            ", ".join(scenario.variations),
            f"{scenario.assessment.horizon} steps, {horizon_s:g} s",
        )
    console.print(table)


@app.command()
def train(
    scenario: ScenarioArgument,
    out: Annotated[Path, typer.Option(help="Folder for episodes and assessments.")],
    episodes: Annotated[int, typer.Option(help="Nominal episodes to learn from.", min=1)] = 2048,
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = 0,
    mode: Annotated[
        str, typer.Option(help="'sharpened', 'paper' (literally the paper's), or 'both'.")
    ] = "both",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the episodes that are in OUT.")
    ] = False,
    workers: WorkersOption = None,
) -> None:
    """Simulate the nominal closed loop and learn Γ from it.

    Episodes are kept as they finish: a run that was stopped goes on with --resume.
    """
    from drake_safety.simulation.dataset import completed
    from drake_safety.simulation.rollouts import run_episodes
    from drake_safety.simulation.scenario import load_scenario

    if mode not in (*_MODES, "both"):
        raise ValueError(f"train: mode must be one of {[*_MODES, 'both']}; got '{mode}'")
    loaded = load_scenario(scenario)
    folder = out / "episodes"
    if folder.exists() and completed(folder) and not resume:
        raise ValueError(
            f"{folder} already holds {len(completed(folder))} episodes: pass --resume to go on "
            "with them, or choose another --out"
        )
    with _stages() as stages:
        data = run_episodes(
            loaded,
            episodes,
            seed=seed,
            num_workers=workers,
            path=folder,
            progress=lambda done, total: stages("nominal episodes", done, total),
            extra={"command": _command(), "scenario_yaml": loaded.to_yaml()},
        )
        table = _table("mode", "segments", "unsafe episodes", "CPU time")
        modes = _MODES if mode == "both" else (mode,)
        # The modes are independent: the first is learned here, the others in processes beside.
        with _workers(len(modes) - 1) as submit:
            beside = [submit(_learn, loaded, name, out) for name in modes[1:]]
            rows = [_learn(loaded, modes[0], out, data, stages)]
            for done, learned in enumerate(beside):
                stages(f"{modes[done + 1]}", 0, 1)
                rows.append(learned.result())
                stages(f"{modes[done + 1]}", 1, 1)
        unsafe = f"{data.num_unsafe} of {len(data)} ({data.num_diverged} diverged)"
        for name, (num_segments, cpu_s) in zip(modes, rows, strict=True):
            table.add_row(name, f"{num_segments}", unsafe, f"{cpu_s:.0f} s")
    console.print(table)
    _print_path("episodes  ", out / "episodes")
    for name in modes:
        _print_path("assessment", assessment_file(out, name))


def _print_path(what: str, path: Path) -> None:
    # Whole on one line, so that it can be copied.
    console.print(what, str(path), soft_wrap=True, highlight=False)


@contextlib.contextmanager
def _workers(num_workers: int) -> Iterator[Any]:
    """Gives what submits a call to a worker process; on an error or Ctrl-C the workers end."""
    from joblib.externals.loky import ProcessPoolExecutor

    executor = ProcessPoolExecutor(max_workers=max(num_workers, 1))
    try:
        yield executor.submit
    except BaseException:
        executor.shutdown(wait=False, kill_workers=True)
        raise
    executor.shutdown()


def _learn(
    scenario: Scenario,
    mode: str,
    out: Path,
    data: Episodes | None = None,
    stages: _Stages | None = None,
) -> tuple[int, float]:
    """Learns and saves one mode; returns the number of segments and the CPU time [s]."""
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.simulation.dataset import load_episodes

    def report(stage: str, share: float) -> None:
        if stages is not None:
            stages(f"{mode}: {stage}", round(100 * share), 100)

    started = time.process_time()
    scenario.assessment.mode = mode
    data = load_episodes(out / "episodes") if data is None else data
    assessment = SafetyAssessment(scenario.assessment).fit(data, report)
    assessment.save(assessment_file(out, mode))
    return assessment.training_points_.shape[1], time.process_time() - started


def assessment_file(folder: Path, mode: str) -> Path:
    """Where ``train`` keeps the assessment of a mode."""
    return folder / f"{mode}.safetensors"


def load_assessment(folder: Path, mode: str) -> SafetyAssessment:
    """Loads what ``train`` wrote.

    Raises:
        ValueError: The folder does not hold it.
    """
    from drake_safety.learning.assessment import SafetyAssessment

    path = assessment_file(folder, mode)
    if not path.is_file():
        there = sorted(file.stem for file in folder.glob("*.safetensors"))
        raise ValueError(
            f"{folder} holds no '{mode}' assessment; it holds {there}: "
            "run `drake-safety train` first"
        )
    return SafetyAssessment.load(path)


@app.command()
def run(
    scenario: ScenarioArgument,
    assessment: AssessmentOption,
    push: Annotated[
        list[str] | None,
        typer.Option(
            help="'ball' throws the scenario's own balls; or your own, repeatable: "
            "'time=1 mass=3 speed=9 direction=90' [s, kg, m/s, degrees from x]."
        ),
    ] = None,
    variation: Annotated[str, typer.Option(help="Which plant.")] = "actual",
    recovery: Annotated[
        bool, typer.Option("--recovery/--no-recovery", help="Step when Γ falls.")
    ] = True,
    duration: Annotated[float, typer.Option(help="Seconds to simulate.", min=0.1)] = 5.0,
    seed: Annotated[int, typer.Option(help="Seed of start, plan and noise.")] = 0,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for recording and pictures; ASSESSMENT's by default."),
    ] = None,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Watch live in the browser, in real time.")
    ] = False,
) -> None:
    """Simulate once with Γ in the loop: a recording, a timeline, and what happened when."""
    from pydrake.geometry import Meshcat

    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.stills import render_stills, stack_positions
    from drake_safety.evaluation.timeline_figure import timeline_figure
    from drake_safety.simulation.scenario import load_scenario
    from drake_safety.simulation.throws import run_throw

    loaded = load_scenario(scenario)
    gamma = load_assessment(assessment, mode)
    throws = _throws(loaded, push or [])
    viewer = Meshcat()
    loop = loaded.make_loop(
        variation, assessment=gamma, meshcat=viewer, recovery=recovery, ball=True
    )
    if meshcat:
        console.print(f"live at {viewer.web_url()}")
        input("Press Enter when the browser shows the robot. ")
    ports = (
        "normalized_safety_probability",
        "safety_probability",
        "belief",
        "cause_probability",
        "predicted_margins",
        "ball_state",
    )
    viewer.StartRecording()
    log = run_throw(
        loop,
        0,
        seed=seed,
        throws=throws,
        duration_s=duration,
        log_period_s=0.02,
        ports=ports,
        realtime_rate=1.0 if meshcat else 0.0,
    )
    viewer.StopRecording()
    viewer.PublishRecording()
    folder = (out or assessment) / "run"
    folder.mkdir(parents=True, exist_ok=True)
    recording = folder / "recording.html"
    recording.write_text(viewer.StaticHtml(), encoding="utf-8")
    probability = log.extra[loop.trigger_port][:, 0]
    threshold = loaded.parameters.recovery.threshold
    rises = np.flatnonzero(np.diff(log.recovery_active, prepend=0.0) > 0)
    falls = np.flatnonzero(np.diff(log.recovery_active, append=0.0) < 0)
    triggers = [float(log.time_s[i]) for i in rises]
    spans = [
        (float(log.time_s[i]), float(log.time_s[j])) for i, j in zip(rises, falls, strict=True)
    ]
    positions = stack_positions(
        loop, {loop.robot.name: log.plant_state, "ball": log.extra["ball_state"]}
    )
    figure = timeline_figure(
        log.time_s,
        probability,
        threshold,
        throws=throws,
        trigger_times_s=triggers,
        recovery_intervals_s=spans,
        stills=render_stills(loop, log.time_s, positions, still_times(log, throws, triggers)),
        belief=log.extra["belief"],
        margins=log.margins,
        constraint_names=loop.constraint_names,
    )
    pictures = save(figure, folder / "timeline")
    _print_run(loop, log, throws, triggers, probability)
    _print_path("recording", recording)
    for picture in pictures:
        _print_path("picture  ", picture)


def still_times(log: ThrowLog, throws: list[Throw], triggers: list[float]) -> list[float]:
    """Instants worth a picture: calm, each throw, each trigger, the step at work, the end."""
    end = float(log.time_s[-1])
    times = [0.0]
    for throw in throws:
        times += [throw.time_s - 0.02, throw.time_s + 0.16]
    times += [time + 0.3 for time in triggers[:1]] + [end]
    return sorted({round(min(max(t, 0.0), end) / 0.02) * 0.02 for t in times})


def _print_run(
    loop: Any, log: ThrowLog, throws: list[Throw], triggers: list[float], probability: np.ndarray
) -> None:
    table = _table("time [s]", "event", "Γ")

    def gamma_at(time_s: float) -> str:
        return f"{probability[min(round(time_s / 0.02), len(probability) - 1)]:.2f}"

    events = [
        (
            throw.time_s,
            f"ball of {throw.mass_kg:g} kg at {throw.speed_m_s:g} m/s towards "
            f"{np.degrees(throw.direction_rad):.0f}°",
        )
        for throw in throws
    ]
    for time_s in triggers:
        row = round(time_s / 0.02)
        causes = log.extra["cause_probability"][row]
        cause = loop.constraint_names[int(np.argmax(causes))]
        margin = log.extra["predicted_margins"][row][int(np.argmax(causes))]
        events.append(
            (time_s, f"recovery triggered; expected violation: {cause}, {100 * margin:+.1f} cm")
        )
    if log.has_fallen:
        events.append((log.fall_time_s, "the robot fell"))
    else:
        events.append((float(log.time_s[-1]), "standing"))
    for time_s, event in sorted(events):
        table.add_row(f"{time_s:.2f}", event, gamma_at(time_s))
    console.print(table)


def _throws(scenario: Scenario, push: list[str]) -> list[Throw]:
    from drake_safety.simulation.balls import Throw

    keys = {
        "time": "time_s",
        "mass": "mass_kg",
        "speed": "speed_m_s",
        "direction": "direction_rad",
        "offset": "offset_m",
        "height": "height_m",
    }
    throws: list[Throw] = []
    for text in push:
        if text == "ball":
            throws += scenario.parameters.demonstration
            continue
        values = {}
        for pair in shlex.split(text):
            key, _, value = pair.partition("=")
            if key not in keys:
                raise ValueError(
                    f"--push '{text}': unknown '{key}'; give 'ball', or any of "
                    f"{[f'{key}=NUMBER' for key in keys]}"
                )
            try:
                values[keys[key]] = float(value)
            except ValueError:
                raise ValueError(f"--push '{text}': '{value}' is not a number") from None
        if "direction_rad" in values:
            values["direction_rad"] = float(np.radians(values["direction_rad"]))
        throws.append(Throw(**values))
    return throws


@app.command()
def evaluate(
    scenario: ScenarioArgument,
    assessment: AssessmentOption,
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 1000,
    throws: Annotated[int, typer.Option(help="Fresh balls at the actual plant.", min=0)] = 600,
    calibration_episodes: Annotated[
        int, typer.Option(help="Other nominal episodes, to choose the recalls' thresholds.", min=20)
    ] = 300,
    calibration_throws: Annotated[
        int, typer.Option(help="Other balls, to choose the classifiers' thresholds.", min=1)
    ] = 200,
    seed: Annotated[int, typer.Option(help="Seed of everything that is fresh.")] = 1_000_000,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables and pictures; ASSESSMENT's by default.")
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Judge Γ on fresh episodes and throws, beside the paper's form and direct classifiers."""
    from drake_safety.evaluation.embedding_figure import embedding_figure
    from drake_safety.evaluation.episode_study import evaluate_episodes
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.roc_figure import roc_figure
    from drake_safety.evaluation.scorers import assessment_scorer, classifier_scorers
    from drake_safety.evaluation.throw_study import TriggerRule, evaluate_throws
    from drake_safety.evaluation.throws_figure import throws_figure
    from drake_safety.simulation.dataset import load_episodes
    from drake_safety.simulation.rollouts import run_episodes
    from drake_safety.simulation.scenario import load_scenario

    loaded = load_scenario(scenario)
    folder = out or assessment
    sharpened, paper = (load_assessment(assessment, mode) for mode in _MODES)
    train_set = load_episodes(assessment / "episodes")
    if seed in (train_set.info.seed, train_set.info.seed + 1):
        raise ValueError(f"evaluate: seed {seed} is the training episodes' own; choose another")
    with _stages() as stages:
        test_set = run_episodes(
            loaded,
            episodes,
            seed=seed,
            num_workers=workers,
            progress=lambda done, total: stages("fresh nominal episodes", done, total),
        )
        _check_same_simulation(train_set.info, test_set.info)
        calibration_set = run_episodes(
            loaded,
            calibration_episodes,
            seed=seed + 3,
            num_workers=workers,
            progress=lambda done, total: stages("calibration episodes", done, total),
        )
        scorers = [
            assessment_scorer("sharpened", sharpened, is_normalized=True),
            assessment_scorer("paper", paper, is_normalized=True),
            *classifier_scorers(train_set, stages),
        ]
        figures, scores, labels = evaluate_episodes(scorers, calibration_set, test_set)
        pictures = [
            *save(embedding_figure(sharpened, test_set), folder / "embedding_sharpened"),
            *save(embedding_figure(paper, test_set), folder / "embedding_paper"),
            *save(
                roc_figure({name: (score, labels) for name, score in scores.items()}),
                folder / "roc",
            ),
        ]
        if throws:
            recovery = loaded.parameters.recovery
            literal = assessment_scorer("literal", sharpened, is_normalized=False)
            paper_literal = assessment_scorer("paper_literal", paper, is_normalized=False)
            chosen = scorers[0] if recovery.is_normalized else literal
            rules = [
                TriggerRule(name="sharpened", scorer=chosen, threshold=recovery.threshold),
                TriggerRule(name="sharpened_literal_0.6", scorer=literal, threshold=0.6),
                TriggerRule(name="paper_literal_0.6", scorer=paper_literal, threshold=0.6),
                *(TriggerRule(name=s.name, scorer=s) for s in scorers[2:]),
            ]
            study = evaluate_throws(
                loaded,
                rules,
                num_throws=throws,
                num_calibration=calibration_throws,
                seed=seed + 1,
                calibration_seed=seed + 2,
                num_workers=workers,
                progress=stages,
            )
            figures |= study.figures
            figures["throws.falls_with_recovery"] = figures["throws.sharpened.falls_with_recovery"]
            pictures += save(
                throws_figure(
                    np.array([log.throw.speed_m_s for log in study.logs]),
                    np.array([log.throw.direction_rad for log in study.logs]),
                    {
                        "balancing alone": study.outcomes(),
                        "with recovery, triggered by Γ": study.outcomes("sharpened"),
                    },
                    mass_kg=np.array([log.throw.mass_kg for log in study.logs]),
                ),
                folder / "throws",
            )
    report = {
        "command": _command(),
        "scenario": loaded.name,
        "scenario_hash": test_set.info.scenario_hash,
        "seed": seed,
        "training_seed": train_set.info.seed,
        "training_episodes": len(train_set),
        "versions": _versions(),
        **{key: figure.to_json() for key, figure in figures.items()},
    }
    file = folder / "evaluation.json"
    file.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    _print_episodes(figures, [scorer.name for scorer in scorers])
    if throws:
        _print_throws(figures, [rule.name for rule in rules])
    _print_path("figures", file)
    for picture in pictures:
        _print_path("picture", picture)


def _check_same_simulation(trained: Any, fresh: Any) -> None:
    if trained.scenario_hash != fresh.scenario_hash:
        raise ValueError(
            f"evaluate: the assessment's episodes were made by scenario '{trained.scenario}' with "
            f"hash {trained.scenario_hash[:12]}, but '{fresh.scenario}' now has hash "
            f"{fresh.scenario_hash[:12]}: train again"
        )


def _interval(figure: Any, scale: float = 1.0, digits: int = 3) -> str:
    value, low, high = (scale * x for x in (figure.value, figure.low, figure.high))
    return f"{value:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"


def _print_episodes(figures: dict[str, Any], names: list[str]) -> None:
    for kind, title in (("segments", "per segment"), ("episodes", "per episode, at k = 0")):
        columns = ("auc", "safe_recall", "unsafe_recall", "brier")
        table = _table("scorer", *columns, title=f"Fresh nominal episodes, {title}")
        for name in names:
            table.add_row(name, *(_interval(figures[f"{kind}.{name}.{key}"]) for key in columns))
        console.print(table)


def _print_throws(figures: dict[str, Any], names: list[str]) -> None:
    alone = figures["throws.falls_without_recovery"]
    table = _table(
        "trigger",
        "Γ_thre",
        "falls [%]",
        "false triggers [%]",
        "falls missed",
        "after impact [ms]",
        "before the fall [s]",
        title=f"{alone.n} fresh throws at the actual plant; balancing alone falls in "
        f"{_interval(alone, 100, 1)} %",
    )
    for name in names:
        rule = {
            key.removeprefix(f"throws.{name}."): figure
            for key, figure in figures.items()
            if key.startswith(f"throws.{name}.")
        }
        missed = rule["falls_missed"]
        table.add_row(
            name,
            f"{rule['threshold'].value:.2f}",
            _interval(rule["falls_with_recovery"], 100, 1),
            _interval(rule["false_triggers"], 100, 1),
            f"{round(missed.value * missed.n) if missed.n else 0} of {missed.n}",
            f"{1000 * rule['trigger_after_impact_s'].value:.0f}",
            f"{rule['trigger_before_fall_s'].value:.2f}",
        )
    console.print(table)


def _command() -> str:
    return shlex.join(["drake-safety", *sys.argv[1:]])


def _versions() -> dict[str, str]:
    import importlib.metadata

    import drake_safety

    names = ("drake", "numpy", "scipy", "scikit-learn", "torch")
    versions = {name: importlib.metadata.version(name) for name in names}
    return {"drake_safety": drake_safety.__version__, **versions}


def main() -> None:
    """Runs the command; what a user did wrong is one line, not a traceback."""
    handler = RichHandler(console=console, show_path=False)
    logging.getLogger("drake_safety").addHandler(handler)
    try:
        sys.exit(app(standalone_mode=False))
    except (ValueError, OSError) as error:
        console.print("error", error, style="red", highlight=False, soft_wrap=True)
        sys.exit(2)
    except (typer.Abort, KeyboardInterrupt):
        console.print("stopped; finished episodes are kept", highlight=False)
        sys.exit(130)
    except Exception as error:
        # Typer's own errors (unknown options, wrong types) know how to show themselves.
        if not hasattr(error, "exit_code") or not hasattr(error, "show"):
            raise
        error.show()
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
