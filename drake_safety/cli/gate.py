"""``drake-safety gate``: whether a loop fails more often than another one."""

import contextlib
import html
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydrake.geometry import Meshcat
from typer import Argument, Exit, Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.figure_style import save, spoken
from drake_safety.evaluation.gate_figure import gate_figure
from drake_safety.evaluation.loop_comparison import (
    UNDECIDED,
    WORSE,
    ComparedPlant,
    Verdict,
    check_pair,
    compare_loops,
    make_paired,
)
from drake_safety.evaluation.outcome_files import (
    FAILED,
    compare_outcomes,
    read_outcomes,
    write_outcomes,
)
from drake_safety.evaluation.outcomes import UNSAFE, Outcome
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column
from drake_safety.files.atomic import write_file
from drake_safety.files.reading import parse_yaml
from drake_safety.learning.seeds import GATE
from drake_safety.live.following_camera import follow
from drake_safety.policies.policy_network import network_kinds
from drake_safety.simulation.rollouts import run_episode
from drake_safety.simulation.scenario import load_scenario

_MOST_SHOWN = 10  # Rows of a table of episodes.
_PANELS = """<!doctype html><meta charset="utf-8">
<style>body { display: flex; height: 95vh } iframe { flex: 1 }</style>"""

MetricOption = Annotated[str, Option(help="unsafe, fall, a constraint, or tracking=BOUND.")]
OutOption = Annotated[Path | None, Option(help="Folder; by default runs/SCENARIO-COMMAND.")]


def gate(
    scenario: console.ScenarioArgument,
    candidates: Annotated[list[str] | None, Argument(help="Candidates, as files or names.")] = None,
    candidate: Annotated[
        list[str] | None,
        Option(
            metavar="KEY=VALUE",
            help="Change of a candidate: policy=FILE, variation=NAME, or a scenario's key; "
            "repeatable.",
        ),
    ] = None,
    baseline: Annotated[str, Option(metavar="KEY=VALUE", help="The same for all loops.")] = "",
    metric: Annotated[
        str, Option(help="unsafe, fall, a constraint, tracking=BOUND; a column of --outcomes.")
    ] = "",
    outcomes: Annotated[
        bool, Option("--outcomes", help="Compare files of outcomes, simulated elsewhere.")
    ] = False,
    worse_by: Annotated[float, Option(help="Difference of the failure rates that matters.")] = 0.02,
    alpha: Annotated[float, Option(help="Probability that any verdict is wrong.")] = 0.05,
    episodes: Annotated[int, Option(help="Most pairs of episodes a candidate.", min=1)] = 2000,
    out: OutOption = None,
    replay: Annotated[int | None, Option(help="Only record this episode.", min=0)] = None,
    mcap: Annotated[bool, Option("--mcap", help="With --replay: MCAP files beside it.")] = False,
    seed: Annotated[int, Option(help="Seed of the episodes.")] = GATE.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Decide whether a candidate fails more often than the baseline, in the same episodes.

    It stops when it knows, and says worse, better, not worse by --worse-by, or undecided. Exit
    code: 3 after an error, 1 if a candidate is worse, 2 if one is undecided, else 0; 130 after
    Ctrl-C. Episodes are kept in OUT: the same command continues. With --outcomes it compares CSV
    files, or LeRobot's eval_info.json: the baseline's, then the candidates'.
    """
    if outcomes:
        if not candidates or candidate or baseline or out or replay is not None:
            without = "without --candidate, --baseline, --out and --replay"
            raise ValueError(f"gate: --outcomes takes files, the baseline's first, {without}")
        if len({Path(one).resolve() for one in (scenario, *candidates)}) <= len(candidates):
            raise ValueError(f"gate: expected different files; got {[scenario, *candidates]}")
        metric, alpha = metric or FAILED, alpha / len(candidates)
        reference = read_outcomes(Path(scenario), metric)
        levels: dict[str, Any] = {"worse_by": worse_by, "alpha": alpha, "seed": seed}
        found = {}
        for name in candidates:
            try:
                read = read_outcomes(Path(name), metric)
                found[name] = compare_outcomes(reference, read, **levels)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        _report(scenario, found, metric, alpha, worse_by)
        _end(found)
    metric = metric or UNSAFE
    given = {Path(one).stem: (one, baseline) for one in candidates or []}
    for text, name in short_names(candidate or []).items():
        given[name] = scenario, f"{baseline} {text}"
    if len(given) < max(replay is None, len(candidates or []) + len(candidate or [])):
        raise ValueError("gate: name different candidates: YAML files, or --candidate KEY=VALUE")
    first = changed_plant(scenario, baseline)
    folder = out or Path("runs") / f"{first.scenario.name}-gate"
    folders.check_writable(folder)
    others: dict[str, ComparedPlant] = {}
    for name, changed in given.items():
        try:
            others[name] = changed_plant(*changed)
            check_pair((first, others[name]), metric=metric, seed=seed)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    if replay is not None:
        motions = {}
        for i, (name, plant) in enumerate({"baseline": first, **others}.items()):
            file = folder / f"episode-{replay}-{i}.mcap" if mcap else None
            motions[name] = partial(_record_episode, (first, plant), replay, seed, file)
        return record_motions(motions, folder / f"episode-{replay}.html")
    gamma = None
    with contextlib.suppress(ValueError):  # That of this very scenario, if one is shipped.
        shipped = folders.assessment_folder(first.scenario, None)
        gamma = folders.load_assessment(shipped.path, MODES[0])
    verdicts: dict[str, Verdict] = {}
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
                    each_look=partial(verdicts.__setitem__, name),
                )
                stages(f"pairs, {name}", verdicts[name].pairs, verdicts[name].pairs)
    finally:  # After Ctrl-C too.
        if verdicts:
            title = f"{first.scenario.name}, {first.variation}"
            _report(title, verdicts, metric, alpha / len(others), worse_by, is_replayed=True)
            candidates_ = {name: asdict(one) for name, one in verdicts.items()}
            for one in candidates_.values():
                del one["outcomes"]  # They are in files.
            entries = {"seed": seed, "metric": metric, "candidates": candidates_}
            write_results(folder / "gate.json", first, Results({}, entries))
            for picture in save(gate_figure(verdicts), folder / "gate"):
                console.say("picture", picture)
            for k, verdict in enumerate(verdicts.values(), start=1):
                files = [folder / f"outcomes-{k}" / f"{s}.csv" for s in ("baseline", "candidate")]
                for file, of_side in zip(files, zip(*verdict.outcomes, strict=True), strict=True):
                    write_outcomes(file, of_side)
                console.say("outcomes", *files)
    _end(verdicts)


def _end(verdicts: Mapping[str, Verdict]) -> NoReturn:
    known = {one.verdict for one in verdicts.values()}
    raise Exit(1 if WORSE in known else 2 if UNDECIDED in known else 0)


def short_names(changes: Sequence[str]) -> dict[str, str]:
    """Names of changes: a file without its folder, unless two changes would be named alike."""
    split = {text: [one.partition("=") for one in shlex.split(text)] for text in changes}
    names = {
        text: " ".join(key + sign + Path(value).name for key, sign, value in pairs)
        for text, pairs in split.items()
    }
    return names if len(set(names.values())) == len(names) else {text: text for text in changes}


def changed_plant(scenario: str, changes: str) -> ComparedPlant:
    """A scenario with KEY=VALUE pairs; files are relative to the working directory."""
    values, variation = {}, "nominal"
    for text in shlex.split(changes):
        key, is_pair, value = text.partition("=")
        if not (key and is_pair):
            raise ValueError(f"gate: a change is KEY=VALUE, such as variation=actual; got '{text}'")
        if key == "variation":
            variation = value
            continue
        key, path = "parameters.policy" if key == "policy" else key, Path(value)
        values[key] = str(path.resolve()) if path.is_file() else parse_yaml(value, f"'{text}'")
    loaded = load_scenario(scenario, values)
    loaded.variation(variation)  # Raises if unknown.
    for text in network_kinds(loaded.task_class().model_files(loaded)):
        console.say(text)
    return ComparedPlant(loaded, variation)


def record_motions(motions: Mapping[str, Callable[[Meshcat], str]], file: Path) -> None:
    """Writes recordings of motions by name, side by side; each returns how it ends."""
    panels = [_PANELS]
    for name, move in motions.items():
        viewer = console.open_viewer()
        viewer.StartRecording()
        end = move(viewer)
        viewer.StopRecording()
        viewer.PublishRecording()
        console.say(f"{name}: {end}")
        panels.append(f'<iframe srcdoc="{html.escape(viewer.StaticHtml())}"></iframe>')
    write_file(file, "\n".join(panels))
    console.say("recording, in this order:", file)


def _record_episode(
    pair: tuple[ComparedPlant, ComparedPlant],
    index: int,
    seed: int,
    file: Path | None,
    viewer: Meshcat,
) -> str:
    """Records one episode of a pair's second loop, also as MCAP; returns how it ends."""
    loop = make_paired(pair, int(pair[0] is not pair[1]), meshcat=viewer)
    with console.recorded(loop, file, follow(loop, viewer)) as monitor:
        episode = run_episode(loop, index, seed=seed, after_leaving_s=math.inf, monitor=monitor)
    end = f"leaves the safe set: {spoken(episode.cause)}"
    return "stays in the safe set" if episode.is_safe else end


def _report(
    title: str,
    verdicts: Mapping[str, Verdict],
    metric: str,
    alpha: float,
    worse_by: float,
    *,
    is_replayed: bool = False,
) -> None:
    """Prints what is known, and the episodes that end differently."""
    rows, points = [], Column("", "", "points", digits=1)
    for name, one in verdicts.items():
        counts = f"{one.both}, {len(one.no_longer_failing)}, {len(one.newly_failing)}"
        pairs = f"{one.pairs}{', unpaired' * (not one.is_paired)}"
        rows.append((name, one.verdict, pairs, counts, points.text(one.difference[-1])))
    failing = "fail: both, only baseline, only candidate"
    columns = ("candidate", "verdict", "pairs", failing, "difference [points]")
    show_rows(f"{title}: {metric}", columns, rows)
    for name, one in verdicts.items():
        if not one.is_paired:
            console.say(f"{name}: no episode is the baseline's; pairs are drawn, for one look")
            continue
        new, old = one.newly_failing, one.no_longer_failing
        show_episodes(f"{name}: episodes that newly fail", new, metric)
        show_episodes(f"{name}: episodes that fail no longer", old, metric)
        for each in [*new, *old][:is_replayed]:
            replay = f"--replay={each.episode}"
            console.say("to see one:", console.command_line("drake-safety", replay))
    ever = ", whenever one looks" * all(one.is_paired for one in verdicts.values())
    console.say(
        f"a verdict or end of an interval is wrong with a probability of at most {100 * alpha:.3g} "
        f"% a candidate{ever}; 'not worse': by {100 * worse_by:g} points"
    )


def show_episodes(title: str, episodes: Sequence[Outcome], metric: str) -> None:
    """Prints failed episodes, the first in full."""
    if len(episodes) > _MOST_SHOWN:
        title += f": the first {_MOST_SHOWN} of {len(episodes)}"
    rows = []
    for one in episodes[:_MOST_SHOWN]:
        commanded = ", ".join(f"{value:.3g}" for value in one.commanded)
        belief = ", ".join(f"{mass:.2f}" for mass in one.belief or ()) or "–"
        cause = spoken(one.cause or metric)
        time = "–" if math.isnan(one.time_s) else f"{one.time_s:.2f}"
        rows.append((one.episode, cause, time, commanded or "–", belief))
    show_rows(title, ("episode", "cause", "at [s]", "commanded", "Γ: safe, unsafe, unknown"), rows)


def show_rows(title: str, columns: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Prints a table, unless it is empty."""
    cells = [[*map(str, row)] for row in rows]
    if cells:
        console.show(console.new_table(*columns, rows=cells, title=title))


def write_results(file: Path, plant: ComparedPlant, results: Results) -> None:
    """Writes results, and what made them."""
    made = console.made_by(plant.scenario.name) | {"variation": plant.variation}
    results.entries = made | results.entries
    results.write(file)
    console.say("figures", file)
