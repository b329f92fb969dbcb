"""Ablations on pendulums: one choice changed at a time, everyone judged alike, and resumed."""

import csv
import io
import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from drake_safety.evaluation.metrics import Bootstrap, Estimate
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.feedback import feedback_sets
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.dataset import EpisodeWriter
from lip_episodes import make_episodes
from studies import ablation_study
from studies.ablation import (
    BASELINE,
    AblationSets,
    EpisodeSet,
    Variant,
    judged_segments,
    list_variants,
    unsafe_scores,
)
from studies.ablation_adaptation import BEFORE, PER_CELL, TOTAL, counting_estimates
from studies.ablation_figure import ablation_figure
from studies.ablation_study import (
    AblationFile,
    AblationRow,
    ablation_verdict,
    rows_to_csv,
    run_ablation,
)
from studies.adaptation_study import TestSet

pytestmark = pytest.mark.train

BASE = AssessmentParameters(
    epochs=3, ensemble_size=1, hidden_sizes=[16], perplexity=8.0, min_count=3
)
FEW = Bootstrap(num_resamples=20)
VARIANTS = [
    Variant(name=BASELINE, group=BASELINE),
    Variant(name="min_count=20", group="k_min", changes={"min_count": 20}),
    Variant(name="blind", group="features", without=["feature_0", "state_3"]),
]


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("episodes")
    found = {}
    for name, (count, seed) in {
        "training": (70, 0),
        "calibration": (40, 1),
        "test": (40, 2),
    }.items():
        episodes = make_episodes(count, seed=seed, noise=0.002)
        with EpisodeWriter(folder / name, episodes.info) as writer:
            for episode in episodes:
                writer.append(episode)
        found[name] = EpisodeSet(path=folder / name, count=count)
    return AblationSets(**found)


def conduct(sets, path, variants=VARIANTS, **options):
    file = AblationFile.open(path, {"command": "test"})
    return run_ablation(
        variants, BASE, sets, file, version="1", bootstrap=FEW, num_workers=1, **options
    )


@pytest.fixture(scope="module")
def whole(sets, tmp_path_factory):
    path = tmp_path_factory.mktemp("ablation") / "ablation.json"
    rows, failed = conduct(sets, path)
    assert failed == {}
    return path, rows


def test_the_baseline_is_what_training_makes_of_the_same_episodes(sets, whole):
    _, rows = whole
    assessment = SafetyAssessment(BASE).fit(sets.training.load())
    segments = judged_segments(sets.test.load(), BASE)
    result = assessment.predict(segments.state, segments.desired_preview, segments.features)
    scores = unsafe_scores(VARIANTS[0], BASE, sets)
    np.testing.assert_array_equal(scores.test, 1.0 - safe_share(result.belief))
    np.testing.assert_array_equal(scores.calibrated, 1.0 - result.probability)
    estimates = rows[0].estimates
    assert (rows[0].name, estimates["auc_gain"].value, estimates["auc_gain"].high) == (
        BASELINE,
        0,
        0,
    )
    for row in rows[1:]:
        gain = row.estimates["auc"].value - estimates["auc"].value
        assert row.estimates["auc_gain"].value == pytest.approx(gain)
        assert row.estimates["auc"].n == estimates["auc"].n


def test_what_a_variant_does_not_see_makes_no_difference_to_it(sets, whole, tmp_path):
    blind = VARIANTS[2]
    before = sets.test.load()
    changed = Episodes(
        before.info,
        [
            replace(
                one,
                features=one.features + np.eye(len(before.info.feature_names))[0],
                state=one.state + 7.0 * np.eye(len(before.info.state_names))[3],
            )
            for one in before
        ],
    )
    for ours, theirs in zip(blind.recut(before, 10), blind.recut(changed, 10), strict=True):
        np.testing.assert_array_equal(ours.state, theirs.state)
        np.testing.assert_array_equal(ours.features, theirs.features)
    assert "state_3" not in blind.recut(before, 10).info.state_names


def test_a_shorter_horizon_is_the_beginning_of_what_was_recorded(sets):
    episodes = sets.training.load()
    half = Variant(name="half", group="horizon").recut(episodes, 5)
    assert half.info.horizon == 5
    for ours, recorded in zip(half, episodes, strict=True):
        # The first five desired outputs from each row on.
        for k in range(5):
            rows = slice(0, len(recorded.time_s) - k)
            np.testing.assert_allclose(
                ours.desired_preview[rows, 3 * k : 3 * k + 3], recorded.desired_output[k:]
            )
    same = Variant(name="same", group="horizon").recut(episodes, 10)
    np.testing.assert_array_equal(same[3].desired_preview, episodes[3].desired_preview)


def test_everyone_is_judged_at_the_baselines_rows(sets):
    shorter = Variant(name="horizon", group="horizon", changes={"horizon": 5})
    scores = unsafe_scores(shorter, BASE, sets)
    assert len(scores.test) == len(judged_segments(sets.test.load(), BASE))
    assert len(scores.calibration) == len(judged_segments(sets.calibration.load(), BASE))


def test_an_ablation_that_was_stopped_goes_on_and_ends_the_same(sets, whole, tmp_path, monkeypatch):
    path, rows = whole
    again = tmp_path / "ablation.json"

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        conduct(sets, again, progress=stop)
    kept = json.loads(again.read_text())["rows"]
    assert [row["name"] for row in kept] == [BASELINE, "min_count=20"]
    trained = []

    def count(variant, *arguments):
        trained.append(variant.name)
        return unsafe_scores(variant, *arguments)

    monkeypatch.setattr(ablation_study, "unsafe_scores", count)
    resumed, _ = conduct(sets, again)
    assert trained == ["blind"]
    assert [asdict(row) for row in resumed] == [asdict(row) for row in rows]
    assert json.loads(again.read_text()) == json.loads(path.read_text())
    conduct(sets, again)
    assert trained == ["blind"]


def test_rows_of_other_episodes_are_not_taken_over(sets, whole, tmp_path, monkeypatch):
    path, _ = whole
    copy = tmp_path / "ablation.json"
    copy.write_text(path.read_text())
    trained = []

    def count(variant, *arguments):
        trained.append(variant.name)
        return unsafe_scores(variant, *arguments)

    monkeypatch.setattr(ablation_study, "unsafe_scores", count)
    fewer = replace(sets, test=replace(sets.test, count=39))
    rows, _ = conduct(fewer, copy, VARIANTS[:1])
    assert trained == [BASELINE] and len(rows) == 1
    assert rows[0].estimates["k0.auc"].n == 39


def test_what_cannot_be_learned_is_left_out_with_the_reason(sets, whole, tmp_path):
    crowded = Variant(name="crowded", group="perplexity", changes={"perplexity": 5000.0})
    path = tmp_path / "ablation.json"
    rows, failed = conduct(sets, path, [VARIANTS[0], crowded])
    assert [row.name for row in rows] == [BASELINE]
    assert "needs more than 15000 segments" in failed["crowded"]
    with pytest.raises(ValueError, match="no variant 'baseline' to compare with"):
        conduct(sets, path, [crowded])
    path.write_text('{"schema": "other"}')
    with pytest.raises(ValueError, match="holds no ablation"):
        AblationFile.open(path, {})


def test_rows_are_written_for_spreadsheets_and_drawn(whole):
    _, rows = whole
    lines = list(csv.DictReader(io.StringIO(rows_to_csv(rows))))
    assert [line["variant"] for line in lines] == [variant.name for variant in VARIANTS]
    assert float(lines[1]["k0.auc.low"]) == rows[1].estimates["k0.auc"].low
    axes = ablation_figure(rows).axes[0]
    dots = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
    assert dots == [row.estimates["auc"].value for row in rows]
    assert [label.get_text() for label in axes.get_yticklabels()][1] == "min count = 20"


def test_each_variant_makes_one_choice_otherwise():
    base = AssessmentParameters(shortest_segment=8)
    states, rates = ["x", "velocity_x"], ["velocity_x", "capture_point"]
    found, left_out = list_variants(base, 200, state_names=states, rate_names=rates)
    assert found[0] == Variant(name=BASELINE, group=BASELINE)
    assert len({variant.name for variant in found}) == len(found)
    for variant in found[1:]:
        parameters = variant.parameters(base)
        differs = {k for k, v in asdict(parameters).items() if v != asdict(base)[k]}
        assert differs == set(variant.changes) - {
            key for key, value in variant.changes.items() if value == getattr(base, key)
        }
        assert differs or variant.num_episodes or variant.without
        # The extent of the grid is no choice of these.
        assert parameters.resolution * parameters.cell_length == pytest.approx(140.0)
    groups = {variant.group for variant in found}
    assert {"score weight δ", "horizon H", "perplexity", "resolution", "k_min"} < groups
    assert {"episodes", "velocities", "mode"} < groups and set(left_out) == {"horizon H"}
    assert {v.num_episodes for v in found if v.group == "episodes"} == {25, 50, 100}
    assert [list(v.without) for v in found if v.group == "velocities"] == [rates[:1], rates]
    quick, _ = list_variants(base, 200, state_names=states, rate_names=rates, quick=True)
    assert {variant.group for variant in quick} == groups and len(quick) < len(found) / 2
    _, left_out = list_variants(base, 200, state_names=states, rate_names=[])
    assert "velocity" in left_out["velocities"]


def test_counting_all_feedback_in_every_cell_is_not_the_same_as_counting_its_own(sets):
    prior = SafetyAssessment(BASE).fit(sets.training.load())
    nominal = sets.calibration.load()
    cause = nominal.info.constraint_names[0]
    actual = [
        replace(one, is_safe=False, cause=cause) if one.index % 2 and one.is_safe else one
        for one in nominal
    ]
    info = replace(nominal.info, variation="actual")
    feedback = feedback_sets(Episodes(info, actual), nominal)
    test = TestSet.of(sets.test.load(), BASE.shortest)
    found = counting_estimates(prior, feedback, test, bootstrap=FEW)
    assert list(found) == [BEFORE, PER_CELL, TOTAL]
    assert found[BEFORE]["auc_gain"].value == 0.0
    assert found[PER_CELL]["brier"] != found[TOTAL]["brier"]
    segments = test.segments
    adapted = prior.adapt(feedback, method="paper").predict(
        segments.state, segments.desired_preview, segments.features
    )
    error = np.mean((1.0 - safe_share(adapted.belief) - segments.is_unsafe) ** 2)
    assert found[PER_CELL]["brier"].value == pytest.approx(error)
    assert prior.parameters.adaptation.count == "cell"


def test_which_variants_win_is_what_the_intervals_of_their_gains_say():
    gains = {
        "baseline": (0.0, 0.0, 0.0),
        "perplexity=10": (-0.05, -0.08, -0.02),
        "resolution=7": (0.02, 0.01, 0.03),
        "min_count=1": (0.004, -0.01, 0.02),
    }
    rows = [
        AblationRow(
            name=name, group=name, fingerprint=name, estimates={"auc_gain": Estimate(*g, 60)}
        )
        for name, g in gains.items()
    ]
    words = ablation_verdict(rows)
    assert "1 of 3 variants beat the baseline's AUC: resolution = 7 (+0.020)" in words
    assert "it beats 1: perplexity = 10 (-0.050)" in words
    assert "for 1 the interval of the difference includes zero" in words
    assert ablation_verdict(rows[:1]) == "There is no variant to compare with the baseline."
    assert ablation_verdict(rows[:2]).startswith("No variant beats the baseline's AUC")
