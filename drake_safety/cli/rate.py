"""``drake-safety rate``: how often a loop fails, in as few episodes as it takes."""

import math
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydrake.geometry import Meshcat
from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.gate import (
    MetricOption,
    OutOption,
    record_motions,
    show_episodes,
    show_rows,
    write_results,
)
from drake_safety.evaluation.failure_rate import estimate_failure_rate
from drake_safety.evaluation.figure_style import save, spoken
from drake_safety.evaluation.loop_comparison import ComparedPlant
from drake_safety.evaluation.outcomes import UNSAFE
from drake_safety.evaluation.rare_failures import RareFailures, Sample, estimate_rare_failure
from drake_safety.evaluation.rare_figure import rare_figure, telling_facts
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column
from drake_safety.learning.seeds import RATE
from drake_safety.live.following_camera import follow
from drake_safety.simulation.normal_space import NormalGenerator, NormalPoint
from drake_safety.simulation.rollouts import run_episode
from drake_safety.simulation.scenario import Scenario, load_scenario

_MOST_SHOWN = 8  # Kinds of failures.


def rate(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    variation: console.VariationOption = "nominal",
    metric: MetricOption = UNSAFE,
    starts: Annotated[int, Option(help="Starts of which Γ is asked.", min=10)] = 10_000,
    episodes: Annotated[int, Option(help="Starts that are simulated.", min=10)] = 500,
    rare: Annotated[
        bool, Option("--rare", help="Search rare failures, without Γ; for rates below 1 %.")
    ] = False,
    samples: Annotated[int, Option(help="With --rare, episodes of a level.", min=40)] = 256,
    replay: Annotated[
        int | None, Option(help="With --rare, only record this failure.", min=1)
    ] = None,
    out: OutOption = None,
    seed: Annotated[int, Option(help="Seed of the episodes.")] = RATE.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Estimate a failure rate from few, informative episodes.

    By default Γ divides starts into strata, which saves episodes where it is sharp. With --rare the
    episodes approach failures level by level, which saves most if random episodes hardly ever fail.
    The estimate is unbiased on average; a search that loses a kind of failure gives too low a rate.
    Episodes are kept in OUT: the same command continues.
    """
    if rare or replay is not None:
        loaded = load_scenario(scenario)
        folder = out or Path("runs") / f"{loaded.name}-rare"
        folders.check_writable(folder)
        with console.open_stages() as stages:
            searched = estimate_rare_failure(
                loaded,
                variation=variation,
                metric=metric,
                samples=samples,
                seed=seed,
                num_workers=workers,
                path=folder,
                progress=partial(stages, "episodes"),
            )
        if replay is not None:
            if replay > len(searched.failures):
                raise ValueError(f"rate: failures are 1 to {len(searched.failures)}; got {replay}")
            motion = partial(_record, loaded, variation, searched.failures[replay - 1])
            return record_motions({f"failure {replay}": motion}, folder / f"failure-{replay}.html")
        return _report_rare(loaded, variation, metric, searched, folder, seed)
    loaded, _, gamma = folders.open_assessment(scenario, assessment)
    gamma.check_unused(seed)
    folder = out or Path("runs") / f"{loaded.name}-rate"
    folders.check_writable(folder)
    with console.open_stages() as stages:
        estimated = estimate_failure_rate(
            loaded,
            gamma,
            variation=variation,
            metric=metric,
            num_starts=starts,
            num_rollouts=episodes,
            seed=seed,
            num_workers=workers,
            path=folder / "episodes",
            progress=stages,
        )
    failures = estimated.failures
    text = Column("", "", "%", digits=2).text(estimated.rate)
    row = (text, estimated.rate.n, len(failures), round(estimated.plain_rollouts))
    columns = ("failure rate", "episodes", "failures", "random episodes of the same variance")
    show_rows(f"{loaded.name}, {variation}: {metric}", columns, [row])
    show_episodes("Failures", failures, metric)
    if estimated.rate.value < 0.01:
        console.say("a rate below 1 %: --rare needs fewer episodes")
    figures = {("", "", "failure_rate"): estimated.rate}
    entries = {"seed": seed, "metric": metric} | asdict(estimated)
    write_results(folder / "rate.json", ComparedPlant(loaded, variation), Results(figures, entries))


def _report_rare(
    loaded: Scenario, variation: str, metric: str, rare: RareFailures, folder: Path, seed: int
) -> None:
    """Prints a rate and the kinds of failures that make it, and writes them with a picture."""
    plain = "" if math.isnan(rare.plain_rollouts) else str(round(rare.plain_rollouts))
    text = f"{rare.rate.value:.1e} ({rare.rate.low:.1e} to {rare.rate.high:.1e})"
    row = (text, f"{rare.search_rate:.1e}", rare.simulations, plain)
    columns = ("failure rate", "by the search", "episodes", "random episodes of the same variance")
    title = f"{loaded.name}, {variation}: {metric}"
    show_rows(title, columns, [row])
    names = telling_facts(rare)
    kinds = [
        (i + 1, f"{100 * one.weight:.0f} %", spoken(one.cause or metric), f"{one.time_s:.2f}")
        + tuple(f"{one.facts[name]:.3g}" for name in names)
        for i, one in enumerate(rare.failures[:_MOST_SHOWN])
    ]
    headings = ("failure", "share", "cause", "at [s]", *map(spoken, names))
    show_rows("Kinds of failures, by their share of the rate", headings, kinds)
    figures = {("", "", "failure_rate"): rare.rate}
    kept: dict[str, Any] = {"failures": [asdict(one) for one in rare.failures[:_MOST_SHOWN]]}
    kept |= {"search_rate": rare.search_rate, "simulations": rare.simulations}
    entries = {"seed": seed, "metric": metric, "plain_rollouts": rare.plain_rollouts} | kept
    write_results(folder / "rare.json", ComparedPlant(loaded, variation), Results(figures, entries))
    if rare.failures:
        for picture in save(rare_figure(rare, title), folder / "rare"):
            console.say("picture", picture)
        console.say("to see one:", console.command_line("drake-safety", "--replay=1"))


def _record(scenario: Scenario, variation: str, sample: Sample, viewer: Meshcat) -> str:
    """Records a failure; returns its cause."""
    options = scenario.options_for("pairs", variation)
    loop = scenario.make_loop(variation, meshcat=viewer, **options)
    point = NormalPoint(np.random.default_rng(sample.seed), np.array(sample.z))
    episode = run_episode(
        loop,
        draws=NormalGenerator(point),
        after_leaving_s=math.inf,
        monitor=follow(loop, viewer),
    )
    return f"leaves the safe set: {spoken(episode.cause)}"
