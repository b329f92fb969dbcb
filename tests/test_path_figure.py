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
    fig = path_figure(assessment, time_s, found.embedding, found.probability, 0.6, events)
    plane, history = fig.axes[:2]
    np.testing.assert_array_equal(plane.lines[1].get_xydata(), found.embedding)
    np.testing.assert_array_equal(history.lines[0].get_ydata(), found.probability)
    marks = {text.get_text(): text.xy for text in plane.texts}
    assert marks["1"] == pytest.approx(found.embedding[0])
    assert marks["2"] == pytest.approx(found.embedding[middle])
    assert history.get_xlabel() == "time [s]\n1 start, 2 ball"
