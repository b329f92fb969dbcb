import json
import math

import numpy as np
import pytest

from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.verdict_tables import verdict_table, verdict_tables
from report_runs import make_figures
from studies.documents import markdown, narrow


def test_what_is_written_is_read_again_with_six_digits(tmp_path):
    estimates = {
        ("plans.fair", "literal_0.6", "collision (arm) 50 %"): Estimate(
            1 / 3, 0.1, 0.9, np.int64(7)
        ),
        ("throws", "", "never"): Estimate(math.inf, math.nan, math.nan, 3),
    }
    entries = {"command": "drake-safety evaluate Γ", "seed": 4}
    Results(estimates, entries).write(tmp_path / "results.json")
    found = Results.read(tmp_path / "results.json")
    assert (found.entries, list(found)) == (entries, list(estimates))
    first, never = found.values()
    assert first == Estimate(0.333333, 0.1, 0.9, 7)
    assert math.isnan(never.value) and never.n == 3


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": [["a", "b", 1.0, 0.0, 1.0, 1]]},
        {"rows": [["a", "b", "c", "much", 0.0, 1.0, 1]]},
        {"rows": [["a", "b", "c", 1.0, 0.0, 1.0, 1e999]]},
        {"schema": "another"},
        {"schema_version": 1},
    ],
)
def test_a_forged_file_and_one_of_another_schema_are_not_read(tmp_path, changes):
    file = tmp_path / "results.json"
    Results({}, {}).write(file)
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(ValueError, match=f"{file} holds no results that can be read: '"):
        Results.read(file)


def test_a_table_has_a_row_a_method_and_marks_the_best_in_every_form():
    difference = {("episodes", "a_minus_b", "auc"): proportion(1, 2)}
    results = Results(make_figures() | difference)
    table = verdict_table(results, "episodes", corner="k = 0")
    assert [row.method for row in table.rows] == ["sharpened", "paper", "gradient_boosting"]
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
