import numpy as np
import pytest

from drake_safety import run_episodes
from drake_safety.learning.training import segments_for
from drake_safety.simulation.dataset import load_episodes
from shuttle_task import shuttling
from studies.scale import counts_for, learned_row
from studies.scale_figure import STAGES, scale_figure

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
    rows = [
        {"is_exact": is_exact, **learned_row(shuttling().assessment, folder, 50, is_exact, fresh)}
        for is_exact in (False, True)
    ]
    for row in rows:
        assert set(row["cpu_s"]) == set(STAGES)
        assert min(row["cpu_s"][stage] for stage in STAGES[:3]) > 0.0
        assert row["peak_gb"] > 0.1
        assert len(row["score"]) > 20
    np.testing.assert_allclose(rows[0]["score"], rows[1]["score"], atol=0.2)
    figure = scale_figure(rows)
    _, right = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()][:4] == list(STAGES)
    assert right.lines[0].get_xdata()[0] == rows[0]["segments"]
