from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_hex

from drake_safety.evaluation import figures
from drake_safety.learning.beliefs import from_scores, fuse_cells
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import split
from lip_episodes import make_episodes


class StandIn:
    """An assessment whose embedding is the pendulum's horizontal position."""

    def __init__(self, episodes):
        self.info_ = episodes.info
        self.parameters = SimpleNamespace(
            horizon=episodes.info.horizon, discount=0.99, initial_uncertainty=0.3
        )
        self.grid_ = Grid(resolution=6, cell_length=0.1)
        segments = split(episodes, stride=1, discount=0.99)
        self.training_points_ = segments.state[None, :, :2]
        masses = from_scores(segments.score, 0.3, segments.cause, 2)
        cells = self.grid_.locate(self.training_points_[0])
        self.beliefs_ = fuse_cells(masses, cells, num_cells=36, min_count=5)[None]

    def predict(self, state, desired_preview, features):
        return SimpleNamespace(embedding=state[:, :2])


@pytest.fixture(scope="module")
def assessment():
    return StandIn(make_episodes(60, seed=0))


@pytest.fixture(scope="module")
def fresh():
    return make_episodes(20, seed=5)


def texts(axes):
    return [text.get_text() for text in axes.texts]


def test_a_picture_is_saved_as_png_and_svg_and_again_with_the_same_bits(tmp_path):
    def picture():
        label = np.array([False, True, True, False])
        return figures.roc_figure({"scorer": (np.array([0.1, 0.9, 0.4, 0.5]), label)})

    png, svg = figures.save(picture(), tmp_path / "new" / "roc.pdf")
    assert (png.name, svg.name) == ("roc.png", "roc.svg")
    assert matplotlib.image.imread(png).shape == (1000, 2000, 4)
    again = figures.save(picture(), tmp_path / "again")
    assert svg.read_bytes() == again[1].read_bytes()
    assert png.read_bytes() == again[0].read_bytes()


def test_drawing_leaves_no_trace_in_the_reader_s_own_settings(assessment, fresh):
    before = dict(matplotlib.rcParams)
    figures.embedding_figure(assessment, fresh)
    assert dict(matplotlib.rcParams) == before


def test_the_map_shows_every_segment_at_its_point_and_every_count(assessment, fresh):
    left, middle, *_ = figures.embedding_figure(assessment, fresh).axes
    segments = split(fresh, stride=5, discount=0.99)
    drawn = left.collections[-1]
    order = np.lexsort(drawn.get_offsets().T)
    expected = np.lexsort(segments.state[:, :2].T)
    np.testing.assert_allclose(drawn.get_offsets()[order], segments.state[expected, :2], rtol=1e-12)
    np.testing.assert_allclose(np.sort(drawn.get_array()), np.sort(segments.score))
    points = assessment.training_points_[0]
    inside = np.abs(points).max(axis=1) < assessment.grid_.half_width
    assert sum(int(count) for count in texts(middle)) == inside.sum()


def test_empty_cells_are_hatched_and_the_others_show_their_belief(assessment, fresh):
    middle = figures.embedding_figure(assessment, fresh).axes[1]
    hollow, filled = middle.collections[:2]
    is_empty = assessment.beliefs_[0, :, 2] == 1.0
    assert 0 < is_empty.sum() < 36
    assert len(hollow.get_paths()) == is_empty.sum()
    assert hollow.get_hatch()
    # Bluer where safer: the blue share grows with the belief.
    colours = filled.get_facecolor()
    safest, least = (
        np.argmax(assessment.beliefs_[0, ~is_empty, 0]),
        np.argmin(assessment.beliefs_[0, ~is_empty, 0]),
    )
    assert colours[safest, 2] > colours[safest, 0]
    assert colours[least, 0] > colours[least, 2]


def test_the_right_panel_shows_causes_or_uncertainty_of_the_beliefs_given(assessment, fresh):
    vacuous = assessment.beliefs_.copy()
    vacuous[...] = 0.0
    vacuous[..., 2] = 1.0
    right = figures.embedding_figure(assessment, fresh, beliefs=vacuous, right="uncertainty").axes[
        2
    ]
    assert len(right.collections[0].get_paths()) == 36
    legend = figures.embedding_figure(assessment, fresh).axes[2].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["support", "height"]
    with pytest.raises(ValueError, match="right is 'mu', expected 'causes' or 'uncertainty'"):
        figures.embedding_figure(assessment, fresh, right="mu")


@pytest.fixture
def run():
    time_s = np.arange(0.0, 2.0, 0.02)
    gamma = np.where(time_s < 1.0, 0.9, 0.2)
    belief = np.column_stack([0.7 * gamma, 0.7 * (1 - gamma), np.full(len(gamma), 0.3)])
    margins = np.column_stack([0.1 - 0.1 * time_s, np.full(len(time_s), 0.05)])
    return {
        "time_s": time_s,
        "gamma": gamma,
        "threshold": 0.6,
        "throws": [SimpleNamespace(time_s=0.98, mass_kg=3.0, speed_m_s=8.0)],
        "trigger_times_s": [1.0],
        "recovery_intervals_s": [(1.0, 1.6)],
        "stills": [(0.5, np.zeros((6, 8, 3), np.uint8)), (1.2, np.full((6, 8, 3), 255, np.uint8))],
        "belief": belief,
        "margins": margins,
        "constraint_names": ["support_polygon", "height"],
    }


def test_the_timeline_joins_each_still_to_its_instant_on_the_curve(run):
    fig = figures.timeline_figure(**run)
    fig.draw_without_rendering()
    stills, gamma = fig.axes[:2], fig.axes[2]
    lines = [artist for artist in fig.artists if hasattr(artist, "coords2")]
    assert len(lines) == 2
    for line, axes, instant, value in zip(lines, stills, (0.5, 1.2), (0.9, 0.2), strict=True):
        assert line.coords2 is gamma.transData
        assert line.coords1 is axes.transAxes
        np.testing.assert_allclose(line.xy2, (instant, value))
    assert stills[0].get_title(loc="left") == "(a)  0.50 s"
    assert [axes.images[0].get_array().max() for axes in stills] == [0, 255]


def test_the_timeline_marks_throw_threshold_trigger_and_recovery(run):
    gamma = figures.timeline_figure(**run).axes[2]
    labels = texts(gamma)
    assert {"threshold 0.6", "3.0 kg, 8.0 m/s", "trigger", "recovery steps"} <= set(labels)
    marks = [line.get_xydata()[0].tolist() for line in gamma.lines if len(line.get_xydata()) == 1]
    assert [1.0, 0.6] in marks
    (span,) = [p for p in gamma.patches if to_hex(p.get_facecolor()) == figures.RECOVERY_COLOUR]
    assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx((1.0, 1.6))


def test_the_timeline_s_belief_is_stacked_to_one_and_margins_are_in_centimetres(run):
    belief, margins = figures.timeline_figure(**run).axes[3:5]
    tops = [c.get_paths()[0].vertices[:, 1].max() for c in belief.collections]
    np.testing.assert_allclose(tops, [0.63, 0.93, 1.0])
    drawn = next(line for line in margins.lines if line.get_label() == "support polygon")
    np.testing.assert_allclose(drawn.get_ydata()[0], 10.0)


def test_the_timeline_needs_no_more_than_gamma(run):
    fig = figures.timeline_figure(run["time_s"], run["gamma"], 0.6)
    assert len(fig.axes) == 1
    gaps = np.where(run["time_s"] < 0.3, np.nan, run["gamma"])
    figures.timeline_figure(run["time_s"], gaps, 0.6, stills=run["stills"]).draw_without_rendering()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"belief": np.zeros((3, 3))}, "belief has 3 rows, expected 100"),
        ({"constraint_names": ["height"]}, r"margins have 2 columns, .*\['height'\]"),
        ({"stills": [(9.0, np.zeros((2, 2, 3)))]}, "a still at 9.0 s is outside"),
    ],
)
def test_the_timeline_refuses_what_does_not_fit(run, change, message):
    with pytest.raises(ValueError, match=message):
        figures.timeline_figure(**{**run, **change})


def test_the_roc_runs_from_corner_to_corner_and_bounds_its_own_area():
    rng = np.random.default_rng(0)
    label = rng.random(500) < 0.4
    score = np.round(rng.normal(size=500) + label, 1)
    score[:5] = np.nan
    whole = figures.roc_figure({"scorer": (score, label)}, thresholds={"scorer": 0.5}).axes[0]
    curve, point = whole.lines[:2]
    x, y = curve.get_data()
    assert (x[0], y[0], x[-1], y[-1]) == (0.0, 0.0, 1.0, 1.0)
    assert np.all(np.diff(x) >= 0.0) and np.all(np.diff(y) >= 0.0)
    area = np.trapezoid(y, x)
    assert curve.get_label() == f"scorer   {area:.3f}"
    # NaN counts among the alarms.
    is_alarm = (score > 0.5) | np.isnan(score)
    assert point.get_xdata()[0] == pytest.approx(is_alarm[~label].mean())
    assert point.get_ydata()[0] == pytest.approx(is_alarm[label].mean())


def test_every_throw_is_drawn_once_and_counted_by_its_outcome():
    speed = np.array([3.0, 5.0, 9.0, 10.0])
    direction = np.array([0.0, 1.0, 2.0, -2.0])
    fig = figures.throws_figure(
        speed,
        direction,
        {
            "alone": ["survived", "survived", "fell", "fell"],
            "recovery": ["survived", "false trigger", "recovered", "fell"],
        },
        mass_kg=np.array([2.0, 2.0, 3.0, 4.0]),
    )
    alone, recovery = fig.axes
    assert [t.get_text() for t in alone.get_legend().get_texts()] == ["survived 2", "fell 2"]
    drawn = np.vstack([marks.get_offsets() for marks in recovery.collections])
    np.testing.assert_allclose(np.sort(drawn[:, 1]), speed)
    fell = next(m for m in recovery.collections if m.get_label() == "fell 1")
    np.testing.assert_allclose(fell.get_offsets(), [[-2.0, 10.0]])


def test_unknown_and_missing_outcomes_are_refused():
    one = np.ones(1)
    with pytest.raises(ValueError, match=r"unknown outcomes \['tripped'\]; the outcomes are"):
        figures.throws_figure(one, one, {"alone": ["tripped"]})
    with pytest.raises(ValueError, match="'alone' has 2 outcomes for 1 throws"):
        figures.throws_figure(one, one, {"alone": ["fell", "fell"]})
