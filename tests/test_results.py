import json
import math

import numpy as np
import pytest

from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results


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
