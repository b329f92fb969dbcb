import json
import math

import numpy as np
import pytest

from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.interval_figure import interval_figure
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.results import Result, Results, key_part
from drake_safety.evaluation.verdict_tables import verdict_table, verdict_tables
from report_runs import make_figures
from studies.documents import markdown, narrow


@pytest.mark.parametrize(
    ("key", "parts"),
    [
        ("plans.fair.sharpened.auc", ("plans.fair", "sharpened", "auc")),
        ("throws.paper_literal_0.6.falls", ("throws", "paper_literal_0.6", "falls")),
        ("plans.learning_curve.512.auc", ("plans.learning_curve", "512", "auc")),
        ("episodes.share_unsafe", ("episodes", "", "share_unsafe")),
        ("gap", ("", "", "gap")),
    ],
)
def test_a_key_names_set_method_and_metric(key, parts):
    row = Result.of(key, proportion(1, 2))
    assert (row.set, row.method, row.metric) == parts
    assert (row.value, row.n) == (0.5, 2)


@pytest.mark.parametrize("name", ["collision (arm)", "a.b", "50 %", "left/right", "fall"])
def test_a_constraint_may_have_any_name(name):
    row = Result.of(f"plans.outcomes.{key_part(name)}", proportion(1, 2))
    assert (row.set, row.method, spoken(row.metric)) == ("plans", "outcomes", name)


def test_rows_are_selected_by_set_method_and_metric():
    results = Results(make_figures())
    assert {row.method for row in results.select(set="throws", metric="false_triggers")} == {
        "sharpened",
        "paper",
        "gradient_boosting",
    }
    assert [row.set for row in results.select(method="paper", metric="auc")] == [
        "segments",
        "episodes",
    ]


def test_what_is_written_is_read_again_with_six_digits(tmp_path):
    estimates = {
        "a.b.c": Estimate(1 / 3, 0.1, 0.9, np.int64(7)),
        "a.b.never": Estimate(math.inf, math.nan, math.nan, 3),
    }
    entries = {"command": "drake-safety evaluate Γ", "seed": 4}
    Results(estimates, entries).write(tmp_path / "results.json")
    found = Results.read(tmp_path / "results.json")
    assert (found.entries, list(found)) == (entries, list(estimates))
    assert found["a.b.c"] == Result.of("a.b.c", Estimate(0.333333, 0.1, 0.9, 7))
    assert math.isnan(found["a.b.never"].value) and found["a.b.never"].n == 3


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({"/elsewhere/x.y": [1.0, 0.0, 1.0, 1]}, "'/elsewhere/x.y'"),
        ({"../../x.y": [1.0, 0.0, 1.0, 1]}, "between dots"),
        ({"x.y": ["much", 0.0, 1.0, 1]}, "much"),
        ({"x.y": [1.0, 0.0, 1.0, 1e999]}, "infinity"),
        ({"x.y": [1.0]}, "not enough values"),
    ],
)
def test_a_forged_file_and_one_of_another_schema_are_not_read(tmp_path, figures, words):
    file = tmp_path / "results.json"
    Results({}, {}).write(file)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"figures": figures}))
    with pytest.raises(ValueError, match=words) as caught:
        Results.read(file)
    assert str(file) in str(caught.value)
    file.write_text('{"schema": "another", "schema_version": 1}')
    with pytest.raises(ValueError, match=r"holds no results.*another"):
        Results.read(file)


def test_a_table_has_a_row_a_method_and_marks_the_best_in_every_form():
    results = Results(make_figures() | {"episodes.a_minus_b.auc": proportion(1, 2)})
    table = verdict_table(results, "episodes", corner="k = 0")
    assert [row.key for row in table.rows] == ["sharpened", "paper", "gradient_boosting"]
    assert markdown(table).splitlines()[:3] == [
        "| k = 0 | AUC | safe recall | unsafe recall | Brier |",
        "|---|---|---|---|---|",
        "| `sharpened`" + 4 * " | 0.900 (0.795–0.962)" + " |",
    ]
    assert table.best(0) == {2} and table.best(3) == {1}
    assert table.better_baselines()[0] == (
        "AUC: gradient boosting, 0.950 against 0.900 (the intervals overlap)"
    )
    assert table.to_rich().row_count == 3
    assert [column.key for column in narrow(table, ["brier", "auc"]).columns] == ["auc", "brier"]
    titles = [one.title for one in verdict_tables(results)]
    assert "Stored calibrations on fresh motions: before the motion" in titles


def test_the_plot_has_each_value_and_its_interval_where_its_method_is():
    rows = Results(make_figures()).select(metric="auc")
    (axes,) = interval_figure(rows).axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["sharpened", "paper", "gradient boosting"]
    assert len(axes.containers) == 2  # Segments and episodes.
    for container in axes.containers:
        points, _, (bars,) = container
        x, y = points.get_data()
        np.testing.assert_allclose(x, [0.9, 40 / 60, 0.95])
        assert [round(place) for place in y] == [0, 1, 2]
        (left, _), (right, _) = bars.get_segments()[0]
        assert (left, right) == pytest.approx((rows[0].low, rows[0].high))
