"""``drake-safety gate``: whether a candidate may replace a baseline, in paired episodes."""

from __future__ import annotations

import contextlib
import re
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

from typer import Argument, Exit, Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.figure_style import save, spoken
from drake_safety.evaluation.gate_figure import gate_figure
from drake_safety.evaluation.loop_comparison import (
    UNDECIDED,
    UNSAFE,
    WORSE,
    Loop,
    Verdict,
    compare_loops,
    make_paired,
)
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.paired_test import ConfidenceSequence
from drake_safety.evaluation.results import Results
from drake_safety.files.atomic import replacing
from drake_safety.files.reading import parse_yaml
from drake_safety.learning.seeds import GATE
from drake_safety.simulation.motion import simulate
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.simulation.scenario import load_scenario

_MOST_CHANGES = 20  # Printed of a candidate.
_FAILING = ("both", "only_baseline", "only_candidate")
_COLUMNS = ("candidate", "verdict", "pairs", *(f"fail: {spoken(one)}" for one in _FAILING))


def gate(
    scenario: console.ScenarioArgument,
    candidates: Annotated[
        list[str] | None, Argument(help="Candidates: names of scenarios, or YAML files.")
    ] = None,
    candidate: Annotated[
        list[str] | None,
        Option(
            metavar="KEY=VALUE",
            help="A candidate by what it changes: policy=FILE, variation=NAME, robot=FILE, or any "
            "key of a scenario, such as parameters.push.share=0.1; several in quotes, with spaces "
            "between them. Each option is one candidate.",
        ),
    ] = None,
    baseline: Annotated[
        str, Option(metavar="KEY=VALUE", help="The same for the baseline and all candidates.")
    ] = "",
    metric: Annotated[
        str, Option(help="Failure: unsafe, fall, a constraint's name, or tracking=BOUND.")
    ] = UNSAFE,
    worse_by: Annotated[float, Option(help="Difference of the failure rates that matters.")] = 0.02,
    alpha: Annotated[
        float, Option(help="Probability of a wrong verdict, over all candidates.")
    ] = 0.05,
    episodes: Annotated[int, Option(help="Most pairs of episodes a candidate.", min=1)] = 2000,
    out: Annotated[
        Path | None, Option(help="Folder of episodes and results; by default runs/SCENARIO-gate.")
    ] = None,
    junit: Annotated[Path | None, Option(help="JUnit XML file to write.")] = None,
    replay: Annotated[
        int | None, Option(help="Only record this episode, in every loop: no verdict.", min=0)
    ] = None,
    seed: Annotated[int, Option(help="Seed of the episodes.")] = GATE.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Decide whether a candidate fails more often than the baseline, in the same episodes.

    It stops when it knows, and says worse, better, not worse by --worse-by, or undecided. Exit
    code: 1 if a candidate is worse, 2 if one is undecided, else 0. Episodes are kept in OUT: the
    same command continues.
    """
    first = _changed(scenario, baseline)
    others = {Path(one).stem: _changed(one, baseline) for one in candidates or []}
    others |= {text: _changed(scenario, f"{baseline} {text}") for text in candidate or []}
    if not others or len(others) < len([*(candidates or []), *(candidate or [])]):
        raise ValueError("gate: name different candidates: YAML files, or --candidate KEY=VALUE")
    folder = out or Path("runs") / f"{first.scenario.name}-gate"
    folders.check_writable(folder, *([] if junit is None else [junit.parent]))
    if replay is not None:
        _record((first, first), 0, replay, seed, folder / f"episode-{replay}-baseline.html")
        for name, other in others.items():
            file = folder / f"episode-{replay}-{_plain(name)}.html"
            _record((first, other), 1, replay, seed, file)
        return
    gamma = None
    with contextlib.suppress(ValueError):  # That of this very scenario, if one is shipped.
        shipped = folders.assessment_folder(first.scenario, None)
        gamma = folders.load_assessment(shipped.path, MODES[0])
    found: dict[str, Verdict] = {}
    try:
        with console.open_stages() as stages:
            for name, other in others.items():
                compare_loops(
                    first,
                    other,
                    metric=metric,
                    worse_by=worse_by,
                    alpha=alpha / len(others),
                    max_pairs=episodes,
                    seed=seed,
                    num_workers=workers,
                    path=folder / "episodes",
                    progress=partial(stages, f"pairs, {name}"),
                    assessment=gamma,
                    each_look=partial(found.__setitem__, name),
                )
                stages(f"pairs, {name}", found[name].pairs, found[name].pairs)
    finally:  # After Ctrl-C too.
        if found:
            _report(first, found, metric, folder, seed)
            if junit is not None:
                _write_junit(junit, first.scenario.name, found)
    verdicts = {one.verdict for one in found.values()}
    raise Exit(1 if WORSE in verdicts else 2 if UNDECIDED in verdicts else 0)


def _changed(scenario: str, changes: str) -> Loop:
    """A scenario with KEY=VALUE pairs; files are relative to the working directory."""
    values, variation = {}, "nominal"
    for text in shlex.split(changes):
        key, is_pair, value = text.partition("=")
        if not (key and is_pair):
            raise ValueError(f"gate: a change is KEY=VALUE, such as variation=actual; got '{text}'")
        if key == "variation":
            variation = value
            continue
        key = "parameters.policy" if key == "policy" else key
        path = Path(value)
        values[key] = str(path.resolve()) if path.is_file() else parse_yaml(value, f"'{text}'")
    loaded = load_scenario(scenario, values)
    loaded.variation(variation)  # There is one.
    return Loop(loaded, variation)


def _plain(name: str) -> str:
    """A name for files and keys."""
    return re.sub(r"[^\w-]+", "_", name)


def _record(pair: tuple[Loop, Loop], side: int, index: int, seed: int, file: Path) -> None:
    """Writes a recording of one episode of a loop."""
    viewer = console.open_viewer(console.LOOPBACK)
    loop = make_paired(pair, side, meshcat=viewer)
    viewer.StartRecording()
    motion = simulate(
        loop,
        lambda context: loop.reset(context, episode_rng(seed, index)),
        ("margins",),
        duration_s=loop.scenario.episode_duration_s,
        watch_period_s=loop.scenario.watch_period_s,
        may_fail=True,
        who=f"episode {index} of '{loop.scenario.name}' (seed {seed})",
    )
    viewer.StopRecording()
    viewer.PublishRecording()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(viewer.StaticHtml(), encoding="utf-8")
    left = f"leaves the safe set at {motion.leave_time_s:.2f} s: {spoken(motion.cause)}"
    fell = f", falls at {motion.fall_time_s:.2f} s" if motion.has_fallen else ""
    told = motion.failure or (left + fell if motion.has_left else "stays in the safe set")
    console.say("recording", f"{file}: {told}")


def _report(
    first: Loop, found: Mapping[str, Verdict], metric: str, folder: Path, seed: int
) -> None:
    """Prints and writes what is known."""
    rows = [
        (
            *(name, one.verdict, f"{one.pairs}"),
            *(f"{getattr(one, who)}" for who in _FAILING),
            _interval(one.difference, 100.0, 1),
            _interval(one.survival_s, 1.0, 3),
        )
        for name, one in found.items()
    ]
    columns = (*_COLUMNS, "difference [points]", "survival [s]")
    title = f"{first.scenario.name}, {first.variation}: {metric}"
    console.show(console.new_table(*columns, rows=rows, title=title))
    for name, one in found.items():
        _show_changes(name, metric, one)
    one = next(iter(found.values()))
    console.say(
        f"a verdict, or an end of an interval, is wrong with a probability of at most "
        f"{100 * one.difference.alpha:.3g} % a candidate, whenever one looks; 'not worse': by "
        f"{100 * one.worse_by:g} points"
    )
    entries = {
        "seed": seed,
        "metric": metric,
        "variation": first.variation,
        "candidates": {name: {"pairs": one.pairs} | asdict(one) for name, one in found.items()},
    }
    figures = {
        f"{_plain(name)}.{what}": Estimate(s.mean[-1], s.low[-1], s.high[-1], one.pairs)
        for name, one in found.items()
        for what, s in {"difference": one.difference, "survival_s": one.survival_s}.items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    Results(figures, console.made_by(first.scenario.name) | entries).write(folder / "gate.json")
    console.say("figures", folder / "gate.json")
    for picture in save(gate_figure(found), folder / "gate"):
        console.say("picture", picture)


def _interval(sequence: ConfidenceSequence, scale: float, digits: int) -> str:
    ends = (sequence.mean, sequence.low, sequence.high)
    mean, low, high = (f"{scale * end[-1]:+.{digits}f}" for end in ends)
    return f"{mean} ({low} to {high})"


def _show_changes(name: str, metric: str, one: Verdict) -> None:
    """Prints the episodes that end differently, and how to see one."""
    if not one.changes:
        return console.say(f"{name}: no episode ends differently")
    columns = ["episode", "change", "cause", "at [s]"]
    has_gamma = one.changes[0].probability is not None
    if has_gamma:
        columns.append("probability of staying safe, at its start")
    rows = [
        (
            f"{change.episode}",
            "newly fails" if change.newly_fails else "fails no longer",
            spoken(change.cause or metric),
            f"{change.time_s:.2f}",
            *([f"{change.probability:.2f}"] if has_gamma else []),
        )
        for change in one.changes[:_MOST_CHANGES]
    ]
    more = len(one.changes) - len(rows)
    told = f", {more} of them only in gate.json" if more else ""
    title = f"{name}: episodes that end differently: {len(one.changes)}{told}"
    console.show(console.new_table(*columns, rows=rows, title=title))
    console.say("to see one:", console.command_line(option=f"--replay={one.changes[0].episode}"))
    return None


def _write_junit(file: Path, suite: str, found: Mapping[str, Verdict]) -> None:
    """Writes JUnit XML, a test case a candidate: worse is a failure, undecided an error."""
    kinds = {WORSE: "failure", UNDECIDED: "error"}
    root = ElementTree.Element("testsuite", name=f"gate {suite}", tests=f"{len(found)}")
    for kind in kinds.values():
        root.set(f"{kind}s", f"{sum(kinds.get(one.verdict) == kind for one in found.values())}")
    for name, one in found.items():
        case = ElementTree.SubElement(root, "testcase", classname=suite, name=name)
        difference = _interval(one.difference, 100.0, 1)
        told = f"{one.verdict} after {one.pairs} pairs: {difference} points"
        if one.verdict in kinds:
            ElementTree.SubElement(case, kinds[one.verdict], message=told)
        ElementTree.SubElement(case, "system-out").text = told
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    console.say("JUnit  ", file)
