"""Tables in README, docs and cards, from stored results and the templates beside this file.

The text between ``<!-- KIND: NAME -->`` and ``<!-- end -->`` is made by ``templates/KIND.md`` from
``docs/results/NAME.json`` alone. A figure in a sentence is between ``<!-- value: EXPRESSION -->``
and ``<!-- end -->``: EXPRESSION formats ``r(NAME, SET, METHOD, METRIC)`` or what ships.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined, UndefinedError

from drake_safety.assessments import load_assessment
from drake_safety.evaluation.figure_style import label_of
from drake_safety.evaluation.push_card import COLUMNS, PushCard
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.shift_study import CONFIDENT
from drake_safety.evaluation.tables import Column, Row, Table
from drake_safety.evaluation.verdict_tables import INPUTS, verdict_table
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import use_of
from drake_safety.robots.family import PlantFamily
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.scenario import Scenario, load_scenario

RESULTS_FOLDER = Path("docs/results")
EVALUATION_FILE, CARD_FILE = "evaluation.json", "README.md"
"""Files of a shipped folder."""
_TEMPLATES = Path(__file__).with_name("templates")
_KINDS = "adaptation|features|monitoring|pushes|rare|results|summary|shifts|walking"
CARDS = {
    "pushes_laikago": ["balancing alone", "balancing alone, MuJoCo", "recovery steps"],
    "pushes_go2": ["Drake", "MuJoCo"],
    "pushes_g1": ["fastsac", "ppo", "fastsac, MuJoCo"],
    "pushes_t1": ["Drake", "MuJoCo"],
}
"""Loops of stored push cards, in their order."""
_OPEN = rf"<!-- (?P<kind>{_KINDS}): (?P<name>[\w/-]+) -->\n"
_BLOCK = re.compile(rf"(?P<start>{_OPEN}).*?(?P<end><!-- end -->)", re.DOTALL)
_VALUE = re.compile(r"(<!-- value: (?P<expression>.*?) -->).*?(<!-- end -->)")
GENERATED = re.compile(f"{_BLOCK.pattern}|{_VALUE.pattern}", re.DOTALL)
"""All generated text of a page."""
SAFE_RECALL, UNSAFE_RECALL = 0.952, 0.987
"""The paper's recalls on 1000 random targets."""
_MODES = re.compile(r"^(sharpened|paper)\b")
_FORMATS = {
    "share": {},
    "point": {"unit": "="},
    "plain": {"digits": 2},
    "value": {"unit": "=", "digits": 2},
    "fine": {"digits": 4},
    "percent": {"unit": "%", "digits": 1},
    "points": {"unit": "points", "digits": 1},
    "single": {"digits": 1},
    "share_of": {"unit": "of"},
    "whole": {"unit": "=", "digits": 0},
    "tenths": {"unit": "=", "digits": 1},
    "rounded": {"unit": "=%", "digits": 0},
}
"""How columns write an estimate, by name."""


def render(kind: str, results: Results, **more: Any) -> str:
    """The text of a template."""
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {name: _column("", "", name).text for name in _FORMATS}
    environment.filters |= {"markdown": markdown, "narrow": narrow}
    environment.filters["origin"] = origin
    environment.globals |= {
        "r": results,
        "entries": results.entries,
        "has": lambda *first: any(key[: len(first)] == first for key in results),
        "label_of": label_of,
        "table": lambda corner, rows, columns: _table(results, corner, rows, columns),
        "delays": _delays(results),
        "verdicts": lambda set, corner: verdict_table(results, set, corner=corner),
        "INPUTS": INPUTS,
        "SAFE_RECALL": SAFE_RECALL,
        "UNSAFE_RECALL": UNSAFE_RECALL,
    }
    text = environment.get_template(f"{kind}.md").render(**more)
    return re.sub(r"\n{3,}", "\n\n", text).strip()


def cards_of(name: str, results: Results) -> dict[str, PushCard]:
    """Push cards by the names of `CARDS`."""
    cards = results.entries["cards"].values()
    return dict(zip(CARDS[name], map(PushCard.of, cards), strict=True))


def origin(seed: int) -> str:
    """A seed, and whether it is one of development or of a release's figures."""
    return f"{seed} ({use_of(seed)})"


def _column(key: str, title: str, format: str = "share") -> Column:
    return Column(key, title, **_FORMATS[format])  # type: ignore[arg-type]


def _table(
    results: Results,
    corner: str,
    rows: Mapping[str, tuple[str, str] | Sequence[tuple[str, str]]],
    columns: Sequence[tuple[str, ...]],
) -> str:
    """Markdown of a table; rows and columns without any result are left out."""
    made = [_column(*column) for column in columns]
    cells = []
    for label, places in rows.items():
        of_columns = [places] * len(made) if isinstance(places, tuple) else places
        keys = [(*pair, column.key) for pair, column in zip(of_columns, made, strict=True)]
        if any(key in results for key in keys):
            cells.append(Row(label, label, [results.get(key) for key in keys]))
    shown = [i for i in range(len(made)) if any(row.estimates[i] for row in cells)]
    return markdown(_with_columns(Table(corner=corner, columns=made, rows=cells), shown))


def markdown(table: Table) -> str:
    """A table as Markdown, estimates with their intervals; a missing one is empty."""
    lines = [[table.corner, *(column.title for column in table.columns)]]
    for row in table.rows:
        cells = zip(table.columns, row.estimates, strict=True)
        texts = ("" if one is None else column.text(one) for column, one in cells)
        lines.append([_MODES.sub(r"`\1`", row.label), *texts])
    head, *rows = ("| " + " | ".join(line) + " |" for line in lines)
    ruler = "|" + "---|" * (1 + len(table.columns))
    return "\n".join([head, ruler, *rows]).replace("|  |", "| |").replace("|  |", "| |")


def narrow(table: Table, keys: Sequence[str]) -> Table:
    """A table with some of its columns, in its order."""
    return _with_columns(table, [i for i, one in enumerate(table.columns) if one.key in keys])


def _with_columns(table: Table, shown: Sequence[int]) -> Table:
    rows = [replace(row, estimates=[row.estimates[i] for i in shown]) for row in table.rows]
    return replace(table, columns=[table.columns[i] for i in shown], rows=rows)


def generate(text: str, folder: Path = RESULTS_FOLDER) -> str:
    """Replaces every block of results and every value in a text by the stored results."""
    blocks = [match["name"] for match in _BLOCK.finditer(text)]
    opened = [match["name"] for match in re.finditer(_OPEN, text)]
    if not GENERATED.search(text):
        raise ValueError(
            "no block of results: put <!-- results: NAME --> and <!-- end --> where the results of "
            f"{RESULTS_FOLDER}/NAME.json belong"
        )
    if blocks != opened:
        raise ValueError(f"results begin for {opened}, but <!-- end --> comes only after {blocks}")

    read = cache(partial(_stored, folder))

    def block(match: re.Match[str]) -> str:
        results, name = read(match["name"]), match["name"]
        more = {"cards": cards_of(name, results), "COLUMNS": COLUMNS} if name in CARDS else {}
        return f"{match['start']}{render(match['kind'], results, **more)}\n{match['end']}"

    return _VALUE.sub(partial(_value, read), _BLOCK.sub(block, text))


def _stored(folder: Path, name: str) -> Results:
    file = folder / f"{name}.json"
    if not file.is_file():
        there = sorted(path.stem for path in folder.glob("*.json"))
        raise ValueError(
            f"{folder} has no results '{name}'; it has {there}: "
            "`python -m studies store RUN` writes them"
        )
    return Results.read(file)


def _value(read: Callable[[str], Results], match: re.Match[str]) -> str:
    """A value with its marks."""
    environment = Environment(undefined=StrictUndefined)
    environment.globals |= {name: _column("", "", name).text for name in _FORMATS}
    environment.globals |= {
        "r": lambda name, *key: read(name)[key],
        "scenario": load_scenario,
        "threshold": lambda name, kind: load_assessment(name).calibrations_[kind].threshold,
        "delays": lambda name: _delays(read(name)),
    }
    try:
        text = environment.from_string(f"{{{{ {match['expression']} }}}}").render()
    except (KeyError, UndefinedError) as error:
        raise ValueError(f"value '{match['expression']}': nothing is stored for {error}") from error
    return f"{match[1]}{text}{match[3]}"


def _delays(results: Results) -> dict[str, float]:
    """Median delay of the monitor's alarm [s] by changed plant; infinite without an alarm."""
    return {
        set.removeprefix("shifts."): math.inf if math.isnan(one.value) else one.value
        for (set, method, metric), one in results.items()
        if (method, metric) == ("monitor", "delay_s")
    }


def card_text(folder: Path, scenario: Scenario) -> str:
    """The card of a shipped folder, as Markdown."""
    results = Results.read(folder / EVALUATION_FILE)
    assessments = {
        mode: SafetyAssessment.load(folder / f"{mode}.safetensors")
        for mode in results.entries["assessment_sha256"]
    }
    info, default = assessments["sharpened"].info_, asdict(PlantVariation())
    plant = asdict(scenario.variation(info.variation)).items()
    changed = {key: value for key, value in plant if value != default[key]}
    text = render(
        "card",
        results,
        scenario=scenario,
        assessments=assessments,
        calibrations={
            (mode, kind): calibration
            for mode, assessment in assessments.items()
            for kind, calibration in assessment.calibrations_.items()
        },
        info=info,
        differences=yaml.safe_dump(changed, default_flow_style=True, width=1000).strip(),
        commands=_commands(results, assessments, scenario.family),
        CONFIDENT=CONFIDENT,
    )
    return f"{text}\n"


def _commands(
    results: Results, assessments: Mapping[str, SafetyAssessment], family: PlantFamily | None
) -> list[str]:
    """The commands that make a shipped folder, as far as its files tell."""
    entries = results.entries
    more = re.findall(r" --(?:motion|falls) \S+", entries["train_command"])
    if family and not assessments["sharpened"].knows_family:
        more.append(" --plants 0")
    name, evaluate = entries["scenario"], entries["command"]
    (folder,) = re.findall(r"--assessment[ =](\S+)", evaluate)
    training = {
        mode: f"--episodes {one.num_episodes} --seed {one.seed}{''.join(more)} --out {folder}"
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
            if one.plants:
                continue  # Chosen with the nominal plant's.
            confidence = "" if one.confidence is None else f"--confidence {one.confidence:g} "
            commands.append(
                f"drake-safety calibrate {name} --assessment {folder} --miss-rate "
                f"{one.miss_rate:g} --false-alarm-rate {one.false_alarm_rate:g} {confidence}"
                f"--episodes {one.num_unsafe + one.num_safe} --seed {one.seed}"
            )
    commands += [evaluate, *([entries["shifts"]["command"]] if "shifts" in entries else [])]
    return [*dict.fromkeys(commands), f"python -m studies ship --assessment {folder}"]
