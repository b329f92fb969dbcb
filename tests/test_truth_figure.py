import re
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.collections import PathCollection, QuadMesh

from cart_episodes import ARRAYS
from cart_pole_task import SCENARIO
from drake_safety import SafetyAssessment, load_scenario, run_episodes
from drake_safety.evaluation.truth_figure import truth_figure
from drake_safety.learning.segments import DIVERGED, Episodes
from lip_assessments import quick_assessment
from lip_episodes import make_episodes

pytestmark = pytest.mark.train

ROOT = Path(__file__).resolve().parents[1]
FRESH = 20


def drawn(axes, kind):
    """The collections of a kind in one panel that hold anything."""
    found = [one for one in axes.collections if isinstance(one, kind)]
    return [one for one in found if kind is QuadMesh or len(one.get_offsets())]


def started_at(episode, places, outside=False):
    """The episode with other values of the first two state variables at its start."""
    state = episode.true_state.copy()
    state[episode.first_step, :2] = places
    changed = replace(episode, true_state=state)
    if not outside:
        return changed
    first = {name: getattr(changed, name)[:1] for name in ARRAYS}
    return replace(changed, **first, is_safe=False, cause="height", first_step=0)


@pytest.fixture(scope="module")
def assessment():
    return quick_assessment("sharpened")


@pytest.fixture(scope="module")
def fresh():
    return make_episodes(FRESH, seed=3)


@pytest.mark.slow
def test_the_lines_of_the_documentation_draw_a_task_of_ones_own(tmp_path, monkeypatch):
    file = tmp_path / "cart_pole.yaml"
    file.write_text(SCENARIO)
    scenario = load_scenario(file)
    assessment = SafetyAssessment(scenario.assessment).fit(run_episodes(scenario, 60))
    text = (ROOT / "docs/own_diagram.md").read_text(encoding="utf-8")
    (block,) = (one for one in re.findall(r"```py\n(.*?)```", text, re.S) if "truth_figure" in one)
    assert block.count("num_episodes=600") == 1
    block = block.replace("num_episodes=600", "num_episodes=24")
    monkeypatch.chdir(tmp_path)
    names = {"assessment": assessment, "scenario": scenario, "run_episodes": run_episodes}
    exec(block, names)
    height, *others = matplotlib.image.imread(tmp_path / "truth.png").shape
    assert (abs(height - 920) <= 1, others) == (True, [1800, 4])
    left, right = names["figure"].axes[:2]
    assert left.get_xlabel() == right.get_xlabel() == "tilt [rad]"
    assert left.get_ylabel() == "tilt rate [rad/s]"
    starts = np.array([episode.true_state[0, [1, 3]] for episode in names["fresh"]])
    (outcomes,) = drawn(right, PathCollection)
    np.testing.assert_array_equal(outcomes.get_offsets(), starts)
    is_safe = [float(episode.is_safe) for episode in names["fresh"]]
    np.testing.assert_array_equal(outcomes.get_array(), is_safe)


def test_points_have_the_calibrated_value_of_their_start_and_the_titles_sum_them_up(
    assessment, fresh
):
    x, y = fresh.info.state_names[:2]
    found = assessment.predict(
        *(
            np.array([getattr(one, name)[one.first_step] for one in fresh])
            for name in ("state", "desired_preview", "features")
        )
    )
    figure = truth_figure(assessment, fresh, x, y)
    left, right = figure.axes[:2]
    values = np.sort(drawn(left, PathCollection)[-1].get_array())
    expected = np.sort(found.probability[found.probability > 0])
    np.testing.assert_allclose(values, expected)
    assert re.fullmatch(r"Starts by probability, AUC [01]\.\d{3}", left.get_title(loc="left"))
    share = 100 * fresh.num_safe / FRESH
    assert right.get_title(loc="left") == f"Simulated: {share:.0f} % of {FRESH} stay safe"
    assert left.get_ylabel() == y.replace("_", " ")


def test_what_is_not_known_is_hollow_and_said_in_the_legend(assessment, fresh):
    strange = [replace(one, state=one.state + 1e3) for one in fresh]
    x, y = fresh.info.state_names[:2]
    figure = truth_figure(assessment, Episodes(fresh.info, strange), x, y)
    (hollow,) = drawn(figure.axes[0], PathCollection)
    assert hollow.get_facecolor().tolist() == [[1.0, 1.0, 1.0, 1.0]]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["Γ: don't know"]


def test_starts_on_a_grid_are_cells_and_those_outside_the_safe_set_are_not_counted(
    assessment, fresh
):
    xs, ys = np.linspace(-1.0, 1.0, 5), np.linspace(0.0, 3.0, 4)
    places = np.random.default_rng(0).permutation([(x, y) for x in xs for y in ys])
    episodes = [
        started_at(one, place, outside=place[1] == 0.0)
        for one, place in zip(fresh, places, strict=True)
    ]
    x, y = fresh.info.state_names[:2]
    figure = truth_figure(assessment, Episodes(fresh.info, episodes), x, y)
    cells, outside = drawn(figure.axes[1], QuadMesh)
    is_safe = np.full((4, 5), np.nan)
    for one, place in zip(episodes, places, strict=True):
        if place[1] > 0.0:
            is_safe[np.argmin(abs(ys - place[1])), np.argmin(abs(xs - place[0]))] = one.is_safe
    np.testing.assert_array_equal(np.ma.filled(cells.get_array(), np.nan), is_safe)
    is_outside = ~np.ma.getmaskarray(outside.get_array())
    np.testing.assert_array_equal(is_outside, np.isnan(is_safe))
    title = figure.axes[1].get_title(loc="left")
    assert title == f"Simulated: {100 * np.nanmean(is_safe):.0f} % of 15 stay safe"
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"outside the safe set", "boundary by simulation"} <= set(words)
    assert not drawn(figure.axes[1], PathCollection)


def test_episodes_that_cannot_be_drawn_are_refused(assessment, fresh):
    x, y = fresh.info.state_names[:2]
    with pytest.raises(ValueError, match=r"no state variable 'speed'; it has \["):
        truth_figure(assessment, fresh, x, "speed")
    with pytest.raises(ValueError, match="truth_figure: the assessment: seed 0 gives episodes"):
        truth_figure(assessment, make_episodes(4, seed=0), x, y)
    diverged = [replace(one, is_safe=False, cause=DIVERGED) for one in fresh]
    outside = [started_at(one, (0.0, 0.0), outside=True) for one in fresh]
    for lost in (diverged, outside):
        with pytest.raises(ValueError, match="none of 20 episodes starts inside the safe set"):
            truth_figure(assessment, Episodes(fresh.info, lost), x, y)
