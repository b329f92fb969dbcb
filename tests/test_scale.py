import pytest

from drake_safety import run_episodes
from drake_safety.learning.segments import training_segments
from drake_safety.simulation.dataset import load_episodes
from shuttle_task import shuttling
from studies.scale import counts_for

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("training")
    run_episodes(shuttling(), 60, num_workers=1, path=path)
    return path


def test_a_size_is_that_of_the_first_episodes_with_so_many_segments(folder):
    episodes, parameters = load_episodes(folder), shuttling().assessment
    count = counts_for({100}, episodes, parameters)[100]
    with_fewer = training_segments(episodes[: count - 1], parameters)
    assert len(with_fewer) < 100 <= len(training_segments(episodes[:count], parameters))
    with pytest.raises(ValueError, match=r"the 60 episodes of .* have .* segments; got sizes"):
        counts_for({100, 10**9}, episodes, parameters)
