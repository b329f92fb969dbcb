from dataclasses import replace

import numpy as np
import pytest

from drake_safety import run_episodes
from drake_safety.learning.training import segments_for
from drake_safety.simulation.dataset import load_episodes
from shuttle_task import shuttling
from studies.scale import STAGES, counts_for, learned_row, row_estimates

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("training")
    run_episodes(shuttling(), 60, num_workers=1, path=path)
    return path


def test_a_size_is_that_of_the_first_episodes_with_so_many_segments(folder):
    episodes, parameters = load_episodes(folder), shuttling().assessment
    count = counts_for({100}, episodes, parameters)[100]
    with_fewer = segments_for(episodes[: count - 1], parameters)[0]
    assert len(with_fewer) < 100 <= len(segments_for(episodes[:count], parameters)[0])
    with pytest.raises(ValueError, match=r"the 60 episodes of .* have .* segments; got sizes"):
        counts_for({100, 10**9}, episodes, parameters)


def test_a_row_says_what_each_stage_costs_and_how_good_the_assessment_is(folder):
    fresh = run_episodes(shuttling(), 20, seed=5, num_workers=1)
    usual = shuttling().assessment
    rows = [
        learned_row(parameters, folder, 50, fresh)
        for parameters in (usual, replace(usual, candidates_per_neighbour=0))
    ]
    for row in rows:
        assert len(row["cpu_s"]) == len(STAGES)
        assert row["cpu_s"][:3].min() > 0.0
        assert row["peak_gb"] > 0.1
        assert len(row["score"]) > 20
        found = row_estimates(row)
        assert found["t-SNE s"].value == row["cpu_s"][1]
        each = 1e3 * row["cpu_s"].sum() / row["segments"]
        assert found["ms a segment"].value == pytest.approx(each)
        assert {one.n for one in found.values()} == {50}
    assert np.abs(rows[0]["score"] - rows[1]["score"]).mean() < 0.1
