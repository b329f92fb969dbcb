"""``python -m studies figures``: the pictures of README and docs, from what ships."""

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from drake_safety.assessments import shipped_folder
from drake_safety.cli.console import say
from drake_safety.cli.run import run
from drake_safety.cli.training_folder import MODES, load_assessment
from drake_safety.diagrams.balancing.throw_study import PAPER_THRESHOLD
from drake_safety.diagrams.balancing.throws import run_throw
from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.embedding_figure import embedding_figure
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.push_figure import push_figure
from drake_safety.evaluation.results import Key, Results
from drake_safety.learning.assessment_file import file_hash
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.simulation.feedback import run_pairs
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from studies.adaptation_figure import adaptation_figure
from studies.documents import CARDS, cards_of
from studies.glance_figures import blocks, glance
from studies.moving_pictures import recovery
from studies.path_figure import path_figure

_ROOT = Path(__file__).resolve().parents[1]
_SEED = DEMONSTRATION.first
_REACHING: dict[str, Any] = {"target": "blue_box", "push": ["torso"], "force": True}
_WALKING: dict[str, Any] = {"target": "0.5 0 0", "push": ["side"], "force": True}
_WALKING |= {"variation": "nominal"}  # On another one the monitor may alarm before the push.
_SHOWN, _PAIRS = 300, 160  # Episodes in the embedding, and pairs of feedback.
_LAIKAGO, _ATLAS, _G1 = (
    f"assessments/{name}/{MODES[0]}.safetensors"
    for name in ("laikago_balancing", "atlas_reaching", "g1_walking")
)
_RESULTS = "docs/results/{}.json"
_CHANGED = ("laikago", "atlas", "go2_walking", "g1_walking")
_ELSEWHERE = "compose.svg, which `python docs/generator/diagram_picture.py` draws by GraphViz"


def _of_run(picture: str, scenario: str, folder: Path, **options: Any) -> Path:
    """A picture of `drake-safety run`."""
    run(scenario, out=folder, **options)
    return folder / "run" / picture


def _path(folder: Path) -> Figure:
    """Two balls thrown at Laikago, in the plane of the paper's Γ, with the paper's threshold."""
    scenario = load_scenario("laikago_balancing")
    recovery = replace(scenario.parameters.recovery, threshold=PAPER_THRESHOLD)
    scenario.parameters = replace(scenario.parameters, recovery=recovery)
    gamma = load_assessment(shipped_folder(scenario.name), "paper")
    throws = scenario.parameters.demonstration
    motion = run_throw(
        scenario.make_loop(assessment=gamma, ball=True),
        0,
        throws=throws,
        seed=_SEED,
        duration_s=5.0,
        ports=("embedding", "safety_probability", "belief"),
    )
    steps = [begin_s for begin_s, _ in motion.recovery_intervals_s]
    events = {f"ball {i}": throw.time_s for i, throw in enumerate(throws, start=1)}
    events |= {f"recovery {i}": begin_s for i, begin_s in enumerate(steps, start=1)}
    is_known = ~is_unknown(motion["belief"], gamma.parameters.initial_uncertainty)
    curve = motion.time_s, motion["embedding"], is_known, motion["safety_probability"][:, 0]
    return path_figure(gamma, *curve, PAPER_THRESHOLD, {"start": 0.0} | events)


def _embedding(folder: Path) -> Figure:
    scenario = load_scenario("atlas_reaching")
    episodes = run_episodes(scenario, _SHOWN, seed=_SEED, **scenario.options_for("evaluation"))
    return embedding_figure(load_assessment(shipped_folder(scenario.name), MODES[0]), episodes)


def _adaptation(folder: Path) -> Figure:
    """Laikago with a payload, in mode `paper`, whose grid alone decides."""
    scenario = load_scenario("laikago_balancing")
    prior = load_assessment(shipped_folder(scenario.name), "paper")
    pairs = run_pairs(scenario, _PAIRS, variation="payload").feedback()
    return adaptation_figure(prior, prior.adapt(pairs), f"{len(pairs)} pairs with a payload")


def interval_figure(estimates: Mapping[Key, Estimate]) -> Figure:
    """Plots a panel for each metric: methods below each other, sets side by side in colours."""
    sets, methods, metrics = ([*dict.fromkeys(names)] for names in zip(*estimates, strict=True))
    with style.drawing_style():
        height = 1.1 + 0.13 * len(methods) * (1 + len(sets))
        fig = style.new_figure(2.2 + 2.6 * len(metrics), height)
        panels = fig.subplots(1, len(metrics), sharey=True)
        for axes, metric in zip(panels, metrics, strict=True):
            for i, name in enumerate(sets):
                keys = [key for key in estimates if (key[0], key[2]) == (name, metric)]
                shown = (estimates[key] for key in keys)
                # NaN ends, as of a value without interval, draw no bar.
                ends = np.array([[one.value, one.low, one.high] for one in shown])
                value, low, high = ends.reshape(-1, 3).T
                axes.errorbar(
                    value,
                    [methods.index(k[1]) + 0.7 * ((i + 0.5) / len(sets) - 0.5) for k in keys],
                    xerr=np.maximum([value - low, high - value], 0.0),
                    fmt="os"[i],
                    color=style.SERIES_COLOURS[i],
                    markersize=5.0,
                    capsize=2.5,
                    label=style.spoken(name).replace(".", ", "),
                )
            axes.set_title(style.label_of(metric))
            axes.grid(axis="x", color=style.FAINT_INK, alpha=0.25)
        panels[0].set_yticks(range(len(methods)), [style.label_of(method) for method in methods])
        panels[0].set_ylim(len(methods) - 0.5, -0.5)
        handles = panels[0].get_legend_handles_labels()
        fig.legend(*handles, loc="outside lower center", ncols=len(sets))
    return fig


def _shifts(name: str, folder: Path) -> Figure:
    """How often Γ is sure and wrong and says "don't know", and when the monitor alarms."""
    results = Results.read(_ROOT / f"docs/results/{name}.json")
    shown = {
        ("gamma", "confident_error"): ("Γ alone", "sure and wrong [%]", 100.0),
        ("monitor", "confident_error_10s"): ("with the monitor", "sure and wrong [%]", 100.0),
        ("gamma", "unknown"): ("Γ alone", "don't know [%]", 100.0),
        ("monitor", "delay_s"): ("with the monitor", "alarm after [s]", 1.0),
    }
    changes = [k.removeprefix("shifts.") for k in results.entries["shifts"]["kinds"]]
    rows = {}
    for place, (set, metric, scale) in shown.items():
        for change in changes:
            one = results.get((f"shifts.{change}", *place))
            if one and (f"shifts.{change}", "monitor", "delay_s") in results:
                value, low, high = (scale * end for end in (one.value, one.low, one.high))
                rows[set, change, metric] = Estimate(value, low, high, one.n)
    return interval_figure(rows)


def _pushes(name: str, folder: Path) -> Figure:
    return push_figure(cards_of(name, Results.read(_ROOT / f"docs/results/{name}.json")))


PICTURES: dict[str, tuple[Callable[[Path], Figure | Path], str]] = {
    "glance": (glance, _LAIKAGO),
    "blocks": (blocks, ""),
    "recovery": (recovery, ""),
    "timeline": (partial(_of_run, "timeline.png", "laikago_balancing", push=["ball"]), _LAIKAGO),
    "path": (_path, _LAIKAGO.replace(*MODES)),
    "reaching": (partial(_of_run, "timeline.png", "atlas_reaching", **_REACHING), _ATLAS),
    "walking_timeline": (partial(_of_run, "timeline.png", "g1_walking", **_WALKING), _G1),
    "embedding": (_embedding, _ATLAS),
    "adaptation": (_adaptation, _LAIKAGO.replace(*MODES)),
    **{f"shifts_{name}": (partial(_shifts, name), _RESULTS.format(name)) for name in _CHANGED},
    **{name: (partial(_pushes, name), _RESULTS.format(name)) for name in CARDS},
}
"""By name, a function that draws a picture or writes it into a folder, and the file it shows."""


def _stamp(picture: Path, source: str) -> None:
    """Writes into a PNG the file that it shows and its hash: a test finds stale pictures."""
    with Image.open(picture) as image:
        text = PngInfo()
        text.add_text("Source", f"{source} {file_hash(_ROOT / source)}")
        image.save(picture, dpi=image.info["dpi"], pnginfo=text, optimize=True)


def figures(
    names: Annotated[
        list[str] | None, typer.Argument(help=f"Among {', '.join(PICTURES)}; all by default.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the pictures.")] = Path("docs/pictures"),
) -> None:
    """Draw the pictures of README and docs from the shipped assessments and stored results."""
    if unknown := set(names or ()) - set(PICTURES):
        raise ValueError(f"figures: no picture {sorted(unknown)}; there are {list(PICTURES)}")
    out.mkdir(parents=True, exist_ok=True)
    for name in names or PICTURES:
        begin_s = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            draw, source = PICTURES[name]
            drawn = draw(Path(folder))
            if isinstance(drawn, Figure):
                drawn = style.save(drawn, Path(folder) / name)[0]
            if source:
                _stamp(drawn, source)
            picture = out / f"{name}{drawn.suffix}"
            shutil.copyfile(drawn, picture)
        say(f"{time.monotonic() - begin_s:4.0f} s ", picture)
    if not names:
        say("left as they are:", _ELSEWHERE)
