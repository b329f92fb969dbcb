import numpy as np
import pytest

from drake_safety.evaluation.path_figure import path_figure
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from lip_assessments import QUICK
from lip_episodes import make_episodes

pytestmark = pytest.mark.train


def test_the_path_is_that_of_the_points_and_events_are_marked_where_they_happen():
    episodes = make_episodes(80)
    parameters = AssessmentParameters(mode="paper", **QUICK | {"epochs": 1, "ensemble_size": 1})
    assessment = SafetyAssessment(parameters).fit(episodes)
    one = episodes[0]
    found = assessment.predict(one.true_state, one.desired_preview)
    time_s = one.time_s
    middle = len(time_s) // 2
    events = {"ball": float(time_s[middle]), "start": 0.0}
    is_known = np.arange(len(time_s)) != 1
    curve = time_s, found.embedding, is_known, found.probability
    fig = path_figure(assessment, *curve, 0.6, events)
    plane, history = fig.axes[:2]
    np.testing.assert_array_equal(plane.lines[0].get_xydata(), found.embedding[is_known])
    np.testing.assert_array_equal(history.lines[0].get_ydata(), found.probability)
    marks = {text.get_text(): text.xy for text in plane.texts if text.get_text()}
    assert marks["1"] == pytest.approx(found.embedding[0])
    assert marks["2"] == pytest.approx(found.embedding[middle])
    # An arrow from each point to the next one known, if it is in another place.
    arrows = [(text.xyann, text.xy) for text in plane.texts if not text.get_text()]
    points, cell = found.embedding[is_known], assessment.grid_.cell_length
    far = np.linalg.norm(np.diff(points, axis=0), axis=1) > cell
    np.testing.assert_array_equal(
        np.reshape(arrows, (-1, 4)), np.hstack([points[:-1], points[1:]])[far]
    )
    assert history.get_xlabel() == "time [s]\n1 start, 2 ball"
