"""``drake-safety pushes``: how hard a push a robot survives, by direction and phase."""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydrake.geometry import Meshcat
from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.ask import parse_target
from drake_safety.cli.gate import (
    changed_plant,
    record_motions,
    short_names,
    show_rows,
    write_results,
)
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.loop_comparison import ComparedPlant
from drake_safety.evaluation.push_card import (
    COLUMNS,
    PushCard,
    PushPlan,
    PushRig,
    make_push_card,
)
from drake_safety.evaluation.push_figure import push_figure
from drake_safety.evaluation.results import Results
from drake_safety.learning.seeds import PUSHES
from drake_safety.live.following_camera import follow

_STRONGER = 1.1  # Ratio of impulses from which a loop is the stronger one in a direction.
_BASELINE, _RECOVERY = "baseline", "recovery"


def pushes(
    scenario: console.ScenarioArgument,
    candidate: Annotated[
        list[str] | None,
        Option(metavar="KEY=VALUE", help="A second loop: policy=FILE, variation=NAME, or a key."),
    ] = None,
    variation: console.VariationOption = "nominal",
    assessment: console.AssessmentOption = None,
    recovery: Annotated[
        bool, Option("--recovery", help="A second loop in which Γ triggers recovery.")
    ] = False,
    target: console.TargetOption = None,
    body: Annotated[str, Option(help="Pushed body; by default the scenario's.")] = "",
    duration: Annotated[float, Option(help="Seconds of a push.", min=0.001)] = 0.1,
    directions: Annotated[int, Option(help="Number of directions.", min=1)] = 16,
    phases: Annotated[int, Option(help="Number of phases of a gait.", min=1)] = 8,
    metric: Annotated[str, Option(help="A failure, as in `gate`; a fall by default.")] = "",
    out: Annotated[Path | None, Option(help="Folder; by default runs/SCENARIO-pushes.")] = None,
    replay: Annotated[bool, Option("--replay", help="Only record the weakest case.")] = False,
    seed: Annotated[int, Option(help="Seed of the phases, and of random pushes.")] = PUSHES.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Find the smallest impulse that makes the robot fall, for each direction and phase.

    Finished directions are kept in OUT: after Ctrl-C the same command continues.
    """
    first = changed_plant(scenario, f"variation={variation}")
    loops: dict[str, tuple[ComparedPlant, dict[str, Any]]] = {_BASELINE: (first, {})}
    for text, name in short_names(candidate or []).items():
        loops[name] = changed_plant(scenario, f"variation={variation} {text}"), {}
    gamma = None
    with contextlib.suppress(*([] if recovery or assessment else [ValueError])):
        # Without a wish, Γ of this very scenario, if one is shipped.
        folder = folders.assessment_folder(first.scenario, assessment)
        gamma = folders.load_assessment(folder.path, MODES[0])
    if recovery:
        loops[_RECOVERY] = first, {"recovery": True, "in_loop": gamma}
    command = None
    if target is not None:
        command = parse_target(first.scenario.make_loop(variation), target).tolist()
    plan = PushPlan(
        body=body,
        duration_s=duration,
        directions=directions,
        phases=phases,
        command=command,
        metric=metric,
        seed=seed,
    )
    out = out or Path("runs") / f"{first.scenario.name}-pushes"
    folders.check_writable(out)
    for plant, options in loops.values():
        PushRig(plant.scenario, plant.variation, plan, **options)  # Raises before a long job.
    cards: dict[str, PushCard] = {}
    with console.open_stages() as stages:
        for name, (plant, options) in loops.items():
            cards[name] = make_push_card(
                plant.scenario,
                plan,
                variation=plant.variation,
                assessment=gamma if name == _BASELINE else None,
                num_workers=workers,
                path=out,
                progress=partial(stages, f"{name}: directions and phases"),
                **options,
            )
    weakest = min(cards.values(), key=lambda card: card.weakest.survived_n_s)
    if replay:
        motions = {
            name: partial(_move, *loop, plan=plan, weakest=weakest) for name, loop in loops.items()
        }
        record_motions(motions, out / "weakest.html")
        return
    _report(cards, first)
    entries = {"seed": seed, "cards": {name: asdict(card) for name, card in cards.items()}}
    write_results(out / "pushes.json", first, Results({}, entries))
    for picture in save(push_figure(cards), out / "pushes"):
        console.say("picture", picture)
    console.say("to see the weakest:", console.command_line("drake-safety", "--replay"))


def _move(
    plant: ComparedPlant,
    options: Mapping[str, Any],
    viewer: Meshcat,
    *,
    plan: PushPlan,
    weakest: PushCard,
) -> str:
    """Records the weakest push; returns how it ends."""
    rig = PushRig(plant.scenario, plant.variation, plan, meshcat=viewer, **options)
    cell = weakest.weakest
    impulse = cell.critical_n_s if math.isfinite(cell.critical_n_s) else cell.survived_n_s
    motion = rig.pushed(impulse, cell.direction, cell.phase, monitor=follow(rig.loop, viewer))
    end = f"leaves the safe set: {motion.cause}" if motion.has_left else "stays in the safe set"
    return f"{'falls' if motion.has_fallen else end} after {impulse:.0f} N·s"


def _report(cards: Mapping[str, PushCard], first: ComparedPlant) -> None:
    """Prints the weakest directions, and which loop is stronger where."""
    rows = [(name, *card.summary) for name, card in cards.items()]
    title = f"{first.scenario.name}, {first.variation}: largest survived impulses"
    show_rows(title, ("loop", *COLUMNS), rows)
    card = cards[_BASELINE]
    period = f"a gait of {card.period_s:.2f} s" if card.period_s else "a robot that stands"
    console.say(
        f"{card.num_pushes} pushes of {card.plan.duration_s:g} s on {card.plan.body} of {period}; "
        f"in brackets: by mass · √(g · height), {card.unit_n_s:.0f} N·s"
    )
    console.say("islands: failures with random impulses below the smallest that fails")
    console.say("joint speed: the fastest joint's, by its stated one, in 95 % of survived pushes")
    worst = card.grid("survived_n_s").min(axis=1)
    for name, other in cards.items():
        ratio = other.grid("survived_n_s").min(axis=1) / np.maximum(worst, 1e-9)
        if name != _BASELINE:
            counts = {"stronger": ratio > _STRONGER, "weaker": ratio < 1.0 / _STRONGER}
            angles = 360.0 * np.arange(len(ratio)) / len(ratio)
            words = [
                f"{word} in {is_so.sum()} of {len(ratio)} directions "
                f"({', '.join(f'{a:.0f}°' for a in angles[is_so])})"
                for word, is_so in counts.items()
                if is_so.any()
            ]
            console.say(f"{name}: {'; '.join(words) or 'as strong as the baseline within 10 %'}")
