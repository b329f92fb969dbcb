import pytest

from drake_safety import run_episodes
from drake_safety.evaluation.plan_study import SAFE_RECALL, UNSAFE_RECALL, plans_of
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.dataset import load_episodes
from shuttle_task import shuttling
from studies.learning_curve import learning_curve
from studies.learning_curve_figure import learning_curve_figure

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("training")
    run_episodes(shuttling(), 60, num_workers=1, path=path)
    return path


@pytest.fixture(scope="module")
def plans():
    loop = shuttling().make_loop()
    return [
        plans_of(loop, run_episodes(shuttling(), 40, seed=seed, num_workers=1)) for seed in (1, 2)
    ]


@pytest.fixture(scope="module")
def curve(folder, plans):
    return learning_curve(folder, [30, 60], shuttling().assessment, *plans, num_workers=1)


def test_every_size_has_every_figure_for_all_targets_and_the_fair_ones(curve, plans):
    for size in (30, 60):
        for infix in ("", "fair."):
            for what in ("safe_recall", "unsafe_recall", "auc", "brier", "threshold"):
                assert f"{size}.{infix}{what}" in curve
    assert curve["30.unsafe_recall"].n == plans[1].is_unsafe.sum()
    assert curve["30.fair.unsafe_recall"].n == plans[1].fair().is_unsafe.sum()


def test_what_is_learned_already_is_not_learned_again(folder, plans, curve, monkeypatch):
    known = SafetyAssessment(shuttling().assessment).fit(load_episodes(folder)[:30])
    monkeypatch.setattr(SafetyAssessment, "fit", None)
    reports = []
    again = learning_curve(
        folder,
        [30],
        shuttling().assessment,
        *plans,
        known={30: known},
        num_workers=1,
        progress=lambda *report: reports.append(report[1:]),
    )
    # The first 30 episodes are what the size of 30 means.
    assert again == {key: estimate for key, estimate in curve.items() if key.startswith("30.")}
    assert reports == [(1, 1)]


@pytest.mark.parametrize("sizes", [[0], [10, 61]])
def test_sizes_that_there_are_no_episodes_for_are_refused(folder, plans, sizes):
    with pytest.raises(ValueError, match=rf"60 training episodes; got sizes \[{sizes[-1]}\]"):
        learning_curve(folder, sizes, shuttling().assessment, *plans)


def test_the_picture_has_both_recalls_beside_the_papers(curve):
    panels = learning_curve_figure(curve).axes
    assert [axes.get_title(loc="left") for axes in panels] == ["All targets", "Fair set"]
    for axes, infix in zip(panels, ("", "fair."), strict=True):
        lines = {line.get_label(): line for line in axes.lines}
        drawn = lines["unsafe recall"].get_ydata()
        expected = [curve[f"{size}.{infix}unsafe_recall"].value for size in (30, 60)]
        assert list(drawn) == expected
        levels = {line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1}
        assert {SAFE_RECALL, UNSAFE_RECALL} <= levels
