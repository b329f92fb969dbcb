"""Cards of shipped assessments: one page a folder, from its files and the scenario alone."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import yaml

from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.shift_study import CONFIDENT
from drake_safety.evaluation.tables import Column, Table
from drake_safety.evaluation.verdict_tables import CALIBRATIONS, INPUTS, verdict_table
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import SCHEMA_VERSION
from drake_safety.learning.calibration import MOTION, PLAN, Calibration
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.scenario import Scenario
from studies.shift_table import shift_rows
from studies.stored_results import EVALUATION_FILE

CARD_FILE = "README.md"
_TEMPLATE = Path(__file__).with_name("card.md")
_JUDGED = {
    "episodes": "before the motion",
    "plans": "before the motion",
    "segments": "during the motion, every segment",
    "throws": "recovery from balls thrown at plant `actual`",
}
"""The report's tables that a card has, and what their rows judge."""
_FIGURES = ("auc", "brier", "falls_with_recovery", "false_triggers")
_RATES = ("promised_miss_rate", "miss_rate", "safe_recall", "safe_unknown", "false_alarm_rate")
_WHEN = {PLAN: "before the motion", MOTION: "alarm during it"}
_SHIFT_COLUMNS = {
    "missed": "unsafe motions called safe beforehand [%]",
    "gamma.confident_error": "rows sure and wrong [%]",
    "gamma.unknown": 'rows "don\'t know" [%]',
    "monitor.delay_s": "monitor's alarm after [s]",
}
_NUM_SHIFTS = 5
_PERCENT = Column("", "", "%", digits=1)


def write_card(folder: Path, scenario: Scenario) -> Path:
    """Writes the card of a shipped folder into it.

    Args:
        folder: Folder with the assessments and their evaluation.
        scenario: The scenario.

    Returns:
        The file.
    """
    file = folder / CARD_FILE
    file.write_text(card_text(folder, scenario), encoding="utf-8")
    return file


def card_text(folder: Path, scenario: Scenario) -> str:
    """The card of a shipped folder, as Markdown; the arguments are those of `write_card`."""
    results = Results.read(folder / EVALUATION_FILE)
    assessments = {
        mode: SafetyAssessment.load(folder / f"{mode}.safetensors")
        for mode in results.entries["assessment_sha256"]
    }
    calibrations = {
        (mode, kind): calibration
        for mode, assessment in assessments.items()
        for kind, calibration in assessment.calibrations_.items()
    }
    tables = [
        verdict_table(results, key, corner=corner).narrow(_FIGURES)
        for key, corner in _JUDGED.items()
        if results.select(set=key)
    ]
    link = f"[`{scenario.robot}`](../../models/{scenario.robot}/README.md)"
    return _TEMPLATE.read_text(encoding="utf-8").format(
        name=scenario.name,
        robot=link if scenario.robot else "a plant of its own",
        task=scenario.task,
        constraints=", ".join(map(spoken, assessments["sharpened"].info_.constraint_names)),
        facts="\n".join(f"| {key} | {fact} |" for key, fact in _facts(assessments, scenario)),
        judged=_judged(results),
        inputs=INPUTS,
        figures="\n\n".join(table.to_markdown() for table in tables),
        promises="; ".join(dict.fromkeys(one.promise for one in calibrations.values())),
        thresholds="\n".join(_thresholds(results, calibrations)),
        limits="\n".join(f"- {one}" for one in _limits(results, calibrations, tables)),
        commands="\n".join(_commands(results, assessments)),
        num_first=len(results.entries["first_episodes"]),
    )


def _facts(
    assessments: Mapping[str, SafetyAssessment], scenario: Scenario
) -> list[tuple[str, str]]:
    info, default = assessments["sharpened"].info_, asdict(PlantVariation())
    plant = asdict(scenario.variation(info.variation)).items()
    changed = {key: value for key, value in plant if value != default[key]}
    differences = yaml.safe_dump(changed, default_flow_style=True, width=1000).strip()
    lasts = f"at most {info.num_steps * info.step_s:g} s, a row every {info.step_s:g} s"
    versions = (
        f"drake_safety {info.versions['drake_safety']}, Drake {info.versions['drake']}, schema "
        f"{SCHEMA_VERSION} of the files, scenario `{info.scenario_hash[:12]}`"
    )

    def used(purpose: str) -> str:
        return "; ".join(
            f"`{mode}`: {one.num_episodes} of seed {one.seed}"
            for mode, assessment in assessments.items()
            for one in assessment.used_
            if one.purpose == purpose
        )

    return [
        ("episodes", used("training")),
        ("an episode", lasts),
        ("plant", f"`{info.variation}`: `{differences}`"),
        ("horizon H", f"{info.horizon} steps of {info.preview_stride * info.step_s:g} s"),
        ("episodes for thresholds", used("calibration")),
        ("versions", versions),
        ("licence", "BSD-3-Clause, as the package"),
    ]


def _judged(results: Results) -> str:
    """What the figures are of."""
    found = results
    words = [
        f"On {one.n} fresh episodes of seed {results.entries['seed']}, of which "
        f"{_PERCENT.text(one)} are {what}."
        for key, what in (("plans.outcomes.safe", "safe"), ("episodes.share_unsafe", "unsafe"))
        if (one := found.get(key)) is not None
    ]
    if (alone := found.get("throws.falls_without_recovery")) is not None:
        words.append(f"Of {alone.n} throws {_PERCENT.text(alone)} fall without recovery.")
    return " ".join(words)


def _thresholds(results: Results, calibrations: Mapping[tuple[str, str], Calibration]) -> list[str]:
    columns = [column for column in CALIBRATIONS if column.key in _RATES]
    titles = ["threshold", "safe from", "unsafe below", *(column.title for column in columns)]
    rows = [titles, ["---"] * len(titles)]
    for (mode, kind), one in calibrations.items():
        safe = f"{one.threshold:.3f}" if one.threshold <= 1.0 else "never"
        unsafe = f"{one.unsafe_below:.3f}" if one.unsafe_below > 0.0 else "never"
        found = (results.get(f"calibration.{kind}.{mode}.{c.key}") for c in columns)
        rates = [column.text(one) for column, one in zip(columns, found, strict=True)]
        rows.append([f"`{mode}`, {_WHEN[kind]}", safe, unsafe, *rates])
    return [f"| {' | '.join(row)} |" for row in rows]


def _limits(
    results: Results,
    calibrations: Mapping[tuple[str, str], Calibration],
    tables: Sequence[Table],
) -> list[str]:
    """Where the stored figures are weak."""
    found = results
    limits = ["Every episode is simulated; none is of a real robot."]
    for table in tables:
        if ahead := table.better_baselines():
            limits.append(f"Better than `sharpened`, {table.corner}: {'; '.join(ahead)}.")
    for (mode, kind), one in calibrations.items():
        who = f"`{mode}`, {_WHEN[kind]}, calls"
        missed = found.get(f"calibration.{kind}.{mode}.miss_rate")
        if missed is not None and missed.value > one.miss_rate:
            limits.append(
                f"{who} {_PERCENT.text(missed)} of {missed.n} unsafe episodes safe: more than the "
                f"promised {100 * one.miss_rate:g} %."
            )
        safe = found.get(f"calibration.{kind}.{mode}.safe_recall")
        if safe is not None and safe.value < 0.5:
            limits.append(f"{who} only {_PERCENT.text(safe)} of {safe.n} safe episodes safe.")
    causes = ", ".join(
        f"{spoken(match[1])} {_PERCENT.text(one)} of {one.n}"
        for key, one in found.items()
        if (match := re.fullmatch(r"plans\.causes\.(?!right_cause|by_cause)(\w+)", key))
    )
    if causes:
        limits.append(f"The cause named by a correct refusal is the simulated one in: {causes}.")
    kinds = results.entries.get("shifts", {}).get("kinds", {})
    shifts = [name for name in kinds if name != "nominal" and results.has(f"shifts.{name}.missed")]
    if not shifts:
        return [*limits, "Not judged here: plants, sensors and plans unlike those of training."]
    worst = sorted(shifts, key=lambda name: -found[f"shifts.{name}.missed"].value)[:_NUM_SHIFTS]
    titles = {name: f"{name} ({kinds[name]})" for name in worst}
    limits.append(
        f"No promise holds on what training does not have. The worst {len(worst)} of {len(shifts)} "
        f"shifts for `sharpened`; sure and wrong is Γ ≥ {CONFIDENT:g} in a motion that ends "
        "unsafely:\n\n"
        + "\n".join(f"  {row}" for row in shift_rows(results, titles, _SHIFT_COLUMNS))
    )
    return limits


def _commands(results: Results, assessments: Mapping[str, SafetyAssessment]) -> list[str]:
    """The commands that make the folder, as far as its files tell."""
    entries = results.entries
    name, evaluate = entries["scenario"], entries["command"]
    (folder,) = re.findall(r"--assessment[ =](\S+)", evaluate)
    training = {
        mode: f"--episodes {one.num_episodes} --seed {one.seed} --out {folder}"
        for mode, assessment in assessments.items()
        for one in assessment.used_
        if one.purpose == "training"
    }
    is_one = len(set(training.values())) == 1
    commands = [
        f"drake-safety train {name} {'' if is_one else f'--mode {mode} '}{options}"
        for mode, options in training.items()
    ]
    for assessment in assessments.values():
        for one in assessment.calibrations_.values():
            confidence = "" if one.confidence is None else f"--confidence {one.confidence:g} "
            commands.append(
                f"drake-safety calibrate {name} --assessment {folder} --miss-rate "
                f"{one.miss_rate:g} --false-alarm-rate {one.false_alarm_rate:g} {confidence}"
                f"--episodes {one.num_unsafe + one.num_safe} --seed {one.seed}"
            )
    commands += [evaluate, *([entries["shifts"]["command"]] if "shifts" in entries else [])]
    return [*dict.fromkeys(commands), f"python -m studies ship --assessment {folder}"]
