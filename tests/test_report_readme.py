"""The README's results are those of the stored evaluations, to the letter."""

import re
from pathlib import Path

import pytest

from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.results import Results
from report_runs import make_figures
from studies.readme import generate, rewrite_readme
from studies.stored_results import store_results

ROOT = Path(__file__).resolve().parents[1]
STORED = sorted((ROOT / "docs/results").glob("*.json"))
ENTRIES = {
    "command": "drake-safety evaluate lip --assessment /somebodys/own/lip --episodes 60",
    "seed": 1000,
    "training_seed": 7,
    "training_episodes": 64,
}
BLOCK = "<!-- results: lip -->\nstale words\n<!-- end -->\n"


def write_readme(folder, estimates, text=f"# Title\n\n{BLOCK}\nThe end.\n"):
    store_results(
        Results(estimates, ENTRIES),
        folder / "docs/results/lip.json",
        train_command="drake-safety train lip --resume --out=/somebodys/own/lip",
    )
    readme = folder / "README.md"
    readme.write_text(text)
    return readme


@pytest.mark.parametrize(
    ("name", "is_walking"),
    [("README.md", False), ("docs/results.md", False), ("docs/walking.md", True)],
)
def test_the_committed_tables_are_what_the_stored_evaluations_generate(name, is_walking):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert generate(text, ROOT / "docs/results") == text
    shown = set(re.findall(r"<!-- (?:results|summary|walking): ([\w-]+) -->", text))
    # A stored evaluation that is not shown is as stale as one that is shown wrongly.
    stored = {path.stem for path in STORED}
    assert shown == {name for name in stored if name.endswith("_walking") == is_walking}


def test_a_summary_is_one_table_with_and_without_targets(tmp_path):
    summary = BLOCK.replace("results:", "summary:")
    readme = write_readme(tmp_path, make_figures(), summary)
    rewrite_readme(readme, tmp_path / "docs/results")
    assert "| `sharpened` | 0.900 (0.795–0.962) |" in readme.read_text()
    assert "```sh" not in readme.read_text()
    estimates = {"plans.outcomes.safe": proportion(20, 50)}
    for column in ("safe_recall", "unsafe_recall", "auc"):
        estimates[f"plans.sharpened.{column}"] = proportion(19, 20)
    readme = write_readme(tmp_path, estimates, summary)
    rewrite_readme(readme, tmp_path / "docs/results")
    assert "| *the paper's own* | *0.952* | *0.987* | |" in readme.read_text()


def test_what_is_stored_is_read_again_but_for_folders_of_ones_own(tmp_path):
    write_readme(tmp_path, make_figures())
    results = Results.read(tmp_path / "docs/results/lip.json")
    assert list(results) == list(make_figures())
    for key, estimate in make_figures().items():
        stored = results[key]
        assert (stored.value, stored.low) == pytest.approx((estimate.value, estimate.low), rel=1e-5)
        assert stored.n == estimate.n
    assert results.entries["command"] == (
        "drake-safety evaluate lip --assessment runs/lip --episodes 60"
    )
    assert results.entries["train_command"] == "drake-safety train lip --out=runs/lip"
    assert "/somebodys" not in (tmp_path / "docs/results/lip.json").read_text()


def test_the_text_between_the_markers_is_rewritten_and_no_other(tmp_path):
    readme = write_readme(tmp_path, make_figures())
    assert rewrite_readme(readme, tmp_path / "docs/results") == ["lip"]
    text = readme.read_text()
    assert text.startswith("# Title\n\n<!-- results: lip -->\n```sh\ndrake-safety train lip")
    assert text.endswith("<!-- end -->\n\nThe end.\n")
    assert "stale words" not in text
    assert "Trained on 64 episodes of seed 7. Evaluated on 60 fresh ones of seed 1000" in text
    assert "| `sharpened` | 0.900 (0.795–0.962) |" in text
    assert "| `sharpened` | 0.40 | 10.0 % (3.8–20.5) | 6.7 % (0.8–22.1) | 0 of 20 |" in text
    again = text
    rewrite_readme(readme, tmp_path / "docs/results")
    assert readme.read_text() == again


def test_verdicts_on_targets_stand_beside_the_papers_own(tmp_path):
    estimates = {"plans.outcomes.safe": proportion(20, 50)}
    for name, count in (("sharpened", 19), ("paper", 10)):
        for column in ("safe_recall", "unsafe_recall", "auc"):
            estimates[f"plans.{name}.{column}"] = proportion(count, 20)
    estimates["plans.causes.right_cause"] = proportion(9, 10)
    readme = write_readme(tmp_path, estimates)
    rewrite_readme(readme, tmp_path / "docs/results")
    text = readme.read_text()
    assert "| all targets | safe recall | unsafe recall | AUC |" in text
    assert "| *the paper's own* | *0.952* | *0.987* | |" in text
    assert "of which 40.0 % (26.4–54.8) are safe" in text
    assert "named for 90.0 % (55.5–99.7) of the 10 correctly refused" in text


def test_what_the_other_hand_loses_and_what_fewer_episodes_cost_is_told(tmp_path):
    estimates = {"plans.outcomes.safe": proportion(20, 50)}
    for prefix in ("plans.sharpened", "plans.other_hand.sharpened", "plans.learning_curve.512"):
        for column in ("safe_recall", "unsafe_recall", "auc"):
            estimates[f"{prefix}.{column}"] = proportion(19, 20)
    readme = write_readme(tmp_path, estimates)
    rewrite_readme(readme, tmp_path / "docs/results")
    text = readme.read_text()
    assert "mirrored" not in text
    assert "| training episodes | safe recall | unsafe recall | AUC |" in text
    assert "| 512 | 0.950 (0.751–0.999) | 0.950" in text
    lost = {"safe": Estimate(0.011, -0.002, 0.024, 40), "unsafe": Estimate(0.0, 0.0, 0.0, 40)}
    for what, estimate in lost.items():
        estimates[f"plans.other_hand.sharpened.{what}_recall_loss"] = estimate
    rewrite_readme(write_readme(tmp_path, estimates), tmp_path / "docs/results")
    assert (
        "On the same 40 targets, mirrored, the other hand minus the trained one: -1.1 (-2.4 to "
        "+0.2) points of safe recall, +0.0 (+0.0 to +0.0) points of unsafe recall."
    ) in readme.read_text()


def test_a_figure_that_is_changed_by_hand_is_noticed(tmp_path):
    readme = write_readme(tmp_path, make_figures())
    rewrite_readme(readme, tmp_path / "docs/results")
    forged = readme.read_text().replace("0.900 (0.795–0.962)", "0.990 (0.795–0.962)", 1)
    assert generate(forged, tmp_path / "docs/results") != forged


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing", "has no block of results"),
        ("<!-- results: lip -->\n", "has no block of results"),
        (BLOCK + "<!-- results: lip -->\n", r"comes only after \['lip'\]"),
        (BLOCK.replace("lip", "other"), r"no results 'other' in .*there are \['lip'\]"),
    ],
)
def test_a_readme_that_cannot_be_filled_in_is_refused_and_left_alone(tmp_path, text, message):
    readme = write_readme(tmp_path, make_figures(), text)
    with pytest.raises(ValueError, match=message):
        rewrite_readme(readme, tmp_path / "docs/results")
    assert readme.read_text() == text
