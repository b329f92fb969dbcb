"""What ``evaluate`` says of tasks whose true safe set can be simulated on a grid."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

from drake_safety.cli.console import interval, new_table
from drake_safety.cli.findings import Findings, Judged

if TYPE_CHECKING:
    from drake_safety.evaluation.metrics import Figure


def evaluate_truth(judged: Judged, planes: list[str], resolution: int) -> Findings:
    """Γ of either mode beside the truth on every state plane, and on random plans, at k = 0.

    Args:
        judged: What is judged.
        planes: Names of the planes.
        resolution: Points along either variable.
    """
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.known_truth import (
        agreement,
        random_plan_figures,
        simulate_truth,
    )
    from drake_safety.evaluation.known_truth_figure import known_truth_figure

    truths = [
        simulate_truth(
            judged.scenario,
            plane,
            resolution,
            num_workers=judged.workers,
            progress=partial(judged.stages, f"truth, {plane}"),
        )
        for plane in planes
    ]
    table = new_table(
        "mode",
        "plan",
        "safe [%]",
        "IoU",
        "confident errors [%]",
        "their band [% of a side]",
        title=f"Γ beside the truth on {resolution} x {resolution} simulated starts",
    )
    pictures = []
    entries: dict[str, Any] = {}
    figures: dict[str, Figure] = {}
    for mode, gamma in {"sharpened": judged.sharpened, "paper": judged.paper}.items():
        panels = []
        for truth in truths:
            probability = truth.safety_probability(gamma)
            found = agreement(truth.is_safe, probability)
            panels.append((truth, probability, found))
            entries[f"{mode}.{truth.plane}"] = asdict(found) | {
                "resolution": resolution,
                "safe_share": float(truth.is_safe.mean()),
            }
            table.add_row(
                mode,
                truth.plane,
                f"{100 * truth.is_safe.mean():.1f}",
                f"{found.intersection_over_union:.3f}",
                f"{100 * found.confident_errors:.2f}",
                f"{100 * found.band:.1f}",
            )
        random = random_plan_figures(gamma, judged.test_set)
        table.add_row(
            mode,
            f"{len(judged.test_set)} random ones",
            interval(random["safe_share"], 100, 1),
            interval(random["intersection_over_union"]),
            interval(random["confident_errors"], 100, 2),
            "–",
        )
        figures |= {f"known_truth.{mode}.random.{key}": value for key, value in random.items()}
        figure = known_truth_figure(panels, f"{judged.scenario.name}, {mode}")
        pictures += save(figure, judged.folder / f"known_truth_{mode}")
    return Findings(
        figures=figures, entries={"known_truth": entries}, pictures=pictures, tables=[table]
    )
