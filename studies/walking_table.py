"""The tables of walking in docs/walking.md."""

from __future__ import annotations

from drake_safety.diagrams.walking_parameters import BRANCHES
from drake_safety.evaluation.figure_style import label_of
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results

_NAMES = {
    "sharpened": "Γ, `sharpened`",
    "tilt": "tilt",
    "capture_point_margin": "capture point",
    "tracking_error": "tracking error",
    "smallest_margin": "smallest margin, true state",
    "action_change": "the policy's change of action",
}


def walking_text(results: Results) -> str:
    """The command and the tables of ``python -m studies walking``, as Markdown.

    Args:
        results: Stored results with those of the study.
    """
    entries, found = results.entries["walking"], results
    stated = (results.entries.get(key) for key in ("train_command", "command"))
    commands = [*(str(one) for one in stated if one), str(entries["command"])]
    lines = ["```sh", *commands, "```\n", *_plan_lines(results)]
    lines += [
        f"Of {found['tours.without_fall'].n} tours of a minute "
        f"{_percent(found['tours.without_fall'])} are without a fall. Of "
        f"{found['pushes.fallen'].n} pushed motions {_percent(found['pushes.fallen'])} fall, "
        f"{_plain(found['pushes.push_to_fall_s'])} s after the push begins (median). "
        f"{_percent(found['pushes.fallen_soon'])} of the falls come less than 0.2 s after the push "
        "ends: only an alarm while it acts announces those so early.\n",
        "| alarm | falls announced ≥ 0.2 s ahead | median lead [s] | alarms without leaving the "
        "safe set | false alarms an hour, undisturbed |",
        "|---|---|---|---|---|",
    ]
    for key in entries["thresholds"]:
        alarm = f"alarm.{key}"
        lines.append(
            f"| {_NAMES.get(key) or label_of(key)} | {_percent(found[f'{alarm}.announced'])} | "
            f"{_plain(found[f'{alarm}.lead_s'])} | "
            f"{_percent(found[f'{alarm}.alarms_without_leaving'])} | "
            f"{_plain(found[f'tours.{key}.false_alarms_per_hour'])} |"
        )
    hours = found["tours.hours"].value
    lines.append(f"\nThe last column is of {hours:.1f} h in which the robot stays in its safe set.")
    if results.has("guard.falls_with"):
        lines.append(
            f"\nOf {found['guard.falls_with'].n} commands past the ranges "
            f"{_percent(found['guard.falls_without'])} fall without the guard and "
            f"{_percent(found['guard.falls_with'])} with it; "
            f"{_percent(found['guard.left_without'])} and {_percent(found['guard.left_with'])} "
            "leave the safe set."
        )
    if results.has("guard.unchanged_inside"):
        lines.append(
            f"Inside the ranges it passes on {_percent(found['guard.unchanged_inside'])} of the "
            "time what is asked."
        )
    branches = [name for name in BRANCHES if results.has(f"recovery.{name}.saved")]
    if branches:
        n = found[f"recovery.{branches[0]}.saved"].n
        lines += [
            f"\n| recovery, of {n} falls | saved | impact of those not saved [m/s] | the same "
            "without recovery [m/s] |",
            "|---|---|---|---|",
        ]
        for name in branches:
            key = f"recovery.{name}"
            lines.append(
                f"| {name} | {_percent(found[f'{key}.saved'])} | "
                f"{_plain(found[f'{key}.impact_m_s'])} | "
                f"{_plain(found[f'{key}.impact_without_m_s'])} |"
            )
    if results.has("speed.difference_to_mujoco_m_s"):
        difference = found["speed.difference_to_mujoco_m_s"]
        lines.append(
            f"\nMean velocities over {difference.n} tours differ from MuJoCo's by "
            f"{_plain(difference)} m/s (median)."
        )
    return "\n".join(lines)


def _plan_lines(results: Results) -> list[str]:
    """Verdicts on fresh command profiles at their first row."""
    methods = {
        "sharpened": "Γ, `sharpened`",
        "paper": "Γ, `paper`",
        "gradient_boosting": "gradient boosting",
        "mlp": "MLP",
    }
    found = results
    shown = [name for name in methods if results.has(f"plans.{name}.auc")]
    if not shown:
        return []
    safe = found["plans.outcomes.safe"]
    lines = [
        f"Of {safe.n} fresh command profiles {_percent(safe)} stay in the safe set. Verdicts at "
        "their first row:\n",
        "| | AUC | safe recall | unsafe recall |",
        "|---|---|---|---|",
    ]
    for name in shown:
        cells = [_share(found[f"plans.{name}.{key}"]) for key in _RATES]
        lines.append(f"| {methods[name]} | {' | '.join(cells)} |")
    promise = "calibration.plan.sharpened"
    if results.has(f"{promise}.miss_rate"):
        promised, missed = found[f"{promise}.promised_miss_rate"], found[f"{promise}.miss_rate"]
        lines.append(
            f"\nΓ's threshold promises that {100 * promised.value:g} % of the unsafe ones are "
            f"missed: {_percent(missed)} are. The others' thresholds come from "
            f"{results.entries.get('calibration_episodes')} other profiles, and promise "
            f"{100 * (1 - found['plans.promised_unsafe_recall'].value):.1f} %: recalls are not at "
            "the same promise, AUCs have none."
        )
    return [*lines, ""]


_RATES = ("auc", "safe_recall", "unsafe_recall")


def _share(one: Estimate) -> str:
    return f"{one.value:.3f} ({one.low:.3f}–{one.high:.3f})"


def _percent(one: Estimate) -> str:
    return f"{100 * one.value:.1f} % ({100 * one.low:.1f}–{100 * one.high:.1f})"


def _plain(one: Estimate) -> str:
    return f"{one.value:.2f} ({one.low:.2f}–{one.high:.2f})"
