import re
from pathlib import Path

import pytest

from cart_episodes import make_episode, make_info
from drake_safety.evaluation.results import Results
from drake_safety.simulation.dataset import EpisodeWriter
from drake_safety.simulation.scenario import load_scenario
from report_runs import make_figures
from studies.documents import GENERATED, generate
from studies.publish import documents, evaluated

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
STORED = sorted((ROOT / "docs/results").glob("*.json"))
ENTRIES = {
    "command": "drake-safety evaluate lip --assessment /somebodys/own/lip --episodes 60",
    "seed": 1000,
    "training_seed": 7,
    "training_episodes": 64,
}
BLOCK = "<!-- results: lip -->\nstale words\n<!-- end -->\n"


def filled(folder, estimates, text=f"# Title\n\n{BLOCK}\nThe end.\n"):
    """The text with the results of these estimates, as they are published."""
    Results(estimates, ENTRIES).write(folder / "evaluation.json")
    evaluated(folder).write(folder / "lip.json")
    return generate(text, folder)


@pytest.mark.parametrize("path", documents(ROOT), ids=lambda path: path.stem)
def test_the_committed_text_is_what_the_stored_evaluations_generate(path):
    text = path.read_text(encoding="utf-8")
    assert generate(text, ROOT / "docs/results") == text


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_no_page_states_a_result_that_is_not_generated(path):
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    by_hand = GENERATED.sub("", text)
    # Intervals, and scores with their names.
    assert re.findall(r"\(−?\d[\d.]*(?:–| to )−?\d[\d.]*\)", by_hand) == []
    assert re.findall(r"(?:AUC|Brier score|recall) (?:of |is )?\d\S*", by_hand) == []
    assert "<!-- value:" not in re.sub(r"`[^`]*`", "", by_hand)
    assert not re.search(r"^\s*<!-- value", text, re.MULTILINE)  # It would end the paragraph.


def test_every_stored_evaluation_is_shown():
    # One that is not shown is as stale as one that is shown wrongly.
    text = "".join(path.read_text(encoding="utf-8") for path in PAGES)
    shown = set(re.findall(r"<!-- (?:pushes|rare|results|summary|walking): ([\w-]+) -->", text))
    assert shown == {path.stem for path in STORED}


def test_a_value_in_a_sentence_is_rewritten_and_one_that_is_not_stored_is_an_error(tmp_path):
    place = '"lip", "episodes", "sharpened", "auc"'
    text = f"{BLOCK}Γ has <!-- value: share(r({place})) -->a stale value<!-- end -->, as said.\n"
    made = filled(tmp_path, make_figures(), text)
    estimate = make_figures()["episodes", "sharpened", "auc"]
    value = f"{estimate.value:.3f} ({estimate.low:.3f}–{estimate.high:.3f})"
    assert made.endswith(f"-->{value}<!-- end -->, as said.\n")
    recovery = "scenario('laikago_balancing').parameters.recovery.threshold"
    shipped = generate(f"Below <!-- value: {recovery} -->?<!-- end -->.", tmp_path)
    assert f"-->{load_scenario('laikago_balancing').parameters.recovery.threshold}<!--" in shipped
    with pytest.raises(ValueError, match=r"value 'share\(r\(.*nothing is stored for \('episodes',"):
        generate(text.replace("sharpened", "blunt"), tmp_path)


@pytest.mark.train
def test_what_is_stored_is_read_again_but_for_folders_of_ones_own(tmp_path):
    info = make_info(scenario="lip")
    extra = {"command": "drake-safety train lip --resume --out=/somebodys/own/lip"}
    with EpisodeWriter(tmp_path / "episodes", info, extra) as writer:
        writer.append(make_episode(0))
    filled(tmp_path, make_figures())
    results = Results.read(tmp_path / "lip.json")
    assert list(results) == list(make_figures())
    for key, estimate in make_figures().items():
        stored = results[key]
        assert (stored.value, stored.low) == pytest.approx((estimate.value, estimate.low), rel=1e-5)
        assert stored.n == estimate.n
    assert results.entries["command"] == (
        "drake-safety evaluate lip --assessment runs/lip --episodes 60"
    )
    assert results.entries["train_command"] == "drake-safety train lip --out=runs/lip"
    assert "/somebodys" not in (tmp_path / "lip.json").read_text()


def test_the_text_between_the_markers_is_rewritten_and_no_other(tmp_path):
    text = filled(tmp_path, make_figures())
    assert text.startswith("# Title\n\n<!-- results: lip -->\n```sh\ndrake-safety evaluate lip ")
    assert text.endswith("<!-- end -->\n\nThe end.\n")
    assert "stale words" not in text
    assert "Γ learned from 64 episodes of seed 7. The evaluation has 60 fresh episodes" in text
    assert "| `sharpened` | 0.900 (0.795–0.962) |" in text
    assert "| `sharpened` | 0.40 | 10.0 % (3.8–20.5) | 6.7 % (0.8–22.1) | 0 of 20 |" in text
    # Whatever is changed by hand is written again.
    forged = text.replace("0.900 (0.795–0.962)", "0.990 (0.795–0.962)", 1)
    assert generate(forged, tmp_path) == generate(text, tmp_path) == text
