import re
from dataclasses import replace

import numpy as np
import pytest

from command_line import call
from drake_safety import (
    AssessmentParameters,
    SafetyAssessment,
    load_scenario,
    run_episode,
    run_episodes,
    run_motions,
)
from drake_safety.cli import training_folder
from drake_safety.cli.evaluate import Evaluation, add_family
from drake_safety.learning.calibration import PLAN, calibrate
from drake_safety.learning.maps import held_out_segments
from drake_safety.learning.segments import split, training_segments
from drake_safety.robots.family import PlantFamily
from drake_safety.robots.robot import Payload, PlantVariation
from drake_safety.simulation.dataset import is_same, load_episodes
from drake_safety.simulation.rollouts import run_motion
from drake_safety.simulation.scenario_check import check_scenario

pytestmark = pytest.mark.train
RANGES = {
    "mass_scale": {"uniform": [0.9, 1.2]},
    "foot_friction": {"log_uniform": [0.2, 1.0], "share": 0.5},
    "payload": {"share": 0.25, "mass_kg": {"uniform": [1.0, 2.0]}, "position_m": [0.0, 0.0, 0.1]},
    "shift": {"joints": {"one_of": [{"a.*": {"is_locked": True}}, {"b.*": {"effort_scale": 0.5}}]}},
}
FAMILY = {"plants": 6, "ranges": {"mass_scale": {"uniform": [0.85, 1.2]}}}


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("pendulum", {"family": FAMILY})


@pytest.fixture(scope="module")
def sets(scenario):
    return run_episodes(scenario, 60, num_workers=1), run_episodes(
        scenario, 60, variation="family", seed=1, num_workers=1
    )


def test_plants_have_the_ranges_and_shares_that_are_stated():
    nominal = PlantVariation(mass_scale=0.8, joint_damping=0.3)
    plants = [PlantFamily(ranges=RANGES).plant(nominal, 7, number) for number in range(400)]
    scales, frictions = zip(*((one.mass_scale, one.foot_friction) for one in plants), strict=True)
    assert 0.9 <= min(scales) < 0.91 and 1.19 < max(scales) <= 1.2
    slippery = np.log([one for one in frictions if one])
    # Uniform in the logarithm, whose median is halfway.
    assert abs(np.median(slippery) - 0.5 * np.log(0.2)) < 0.15
    assert 0.4 < len(slippery) / 400 < 0.6
    loads = [one.payload for one in plants if one.payload]
    assert 0.18 < len(loads) / 400 < 0.32
    assert {tuple(one.position_m) for one in loads} == {(0.0, 0.0, 0.1)}
    locked = [next(iter(one.shift.joints.values())).is_locked for one in plants]
    assert 0.4 < np.mean(locked) < 0.6
    assert {one.joint_damping for one in plants} == {0.3}


def test_a_plant_depends_on_seed_and_number_alone_and_not_on_the_shares_of_others():
    nominal, family = PlantVariation(), PlantFamily(ranges=RANGES)
    assert family.plant(nominal, 1, 5) == PlantFamily(ranges=RANGES).plant(nominal, 1, 5)
    assert family.plant(nominal, 1, 5) != family.plant(nominal, 2, 5)
    always = PlantFamily(ranges=RANGES | {"payload": RANGES["payload"] | {"share": 1.0}})
    for number in range(20):
        one, other = family.plant(nominal, 1, number), always.plant(nominal, 1, number)
        assert replace(one, payload=None) == replace(other, payload=None)
        assert isinstance(other.payload, Payload)


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"mass_scale": {"uniform": [2.0, 1.0]}}, "ranges.mass_scale.uniform must be [lowest"),
        ({"mass_scale": {"log_uniform": [0.0, 1.0]}}, "above 0"),
        ({"mass_scale": {"uniform": [0.5]}}, "got [0.5]"),
        ({"mass_scale": {"uniform": [0, 1], "one_of": [1]}}, "must have one of ['uniform'"),
        ({"payload": {"share": 2.0}}, "ranges.payload.share must be in (0, 1]; got 2.0"),
        ({"mass_scal": {"uniform": [0.5, 1]}}, "unknown key 'mass_scal' (did you mean"),
        ({"mass_scale": {"uniform": [-1.0, -0.5]}}, "'mass_scale'"),
        ({"shift": {"joints": {"one_of": 3}}}, "one_of must be a list; got 3"),
        ({}, "ranges must have an entry of a plant variation; got {}"),
        ({"share": 0.5, "mass_scale": 1.1}, "ranges cannot have a share"),
        (
            {"payload": {"position_m": [{"share": 0.5, "uniform": [0, 1]}]}},
            "position_m cannot have",
        ),
        ({"shift": {"one_of": [{"share": 0.1}]}}, "one_of cannot have a share"),
        ({"payload": {"share": 0.001, "mas_kg": 1.0}}, "unknown key 'payload.mas_kg'"),
        ({"mass_scale": {"uniform": [-1e-6, 1.0]}}, "'mass_scale'"),
        ({"shift": {"joints": {"*_hip": {}}}}, "must be a regular expression: nothing to repeat"),
    ],
)
def test_ranges_that_no_plant_can_have_are_refused(ranges, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        load_scenario("pendulum", {"family": {"ranges": ranges}})


def test_undisturbed_motions_are_on_the_plants_in_turn(scenario):
    options = {"variation": "family", "seed": 4, "num_workers": 1}
    motions = run_motions(scenario, 5.0 * scenario.episode_duration_s, plants=2, **options)
    assert [one.plant for one in motions] == [1, 2, 1, 2, 1]
    alone = run_motion(scenario.with_plant(4, 2).make_loop("family"), 1, seed=4)
    np.testing.assert_array_equal(motions[1].state, alone.state)


def test_a_family_leaves_the_nominal_sets_as_they_are(scenario):
    plain = load_scenario("pendulum")
    assert scenario.simulation_hash() == plain.simulation_hash()
    assert scenario.simulation_hash("family") != plain.simulation_hash()
    assert scenario.with_plant(0, 3).simulation_hash() == plain.simulation_hash()
    with pytest.raises(ValueError, match="has no family of plants"):
        run_episodes(plain, 1, variation="family")
    with pytest.raises(ValueError, match="no variation can have the name 'family'"):
        load_scenario("pendulum", {"variations": {"nominal": {}, "family": {}}})


def test_episodes_belong_to_plants_by_their_number(scenario, sets, tmp_path):
    _, family = sets
    assert [one.plant for one in family] == [1 + i % 6 for i in range(60)]
    again = run_episodes(
        scenario, 60, variation="family", seed=1, num_workers=2, path=tmp_path / "family"
    )
    stored = load_episodes(tmp_path / "family")
    assert all(map(is_same, family, again)) and all(map(is_same, family, stored))
    alone = scenario.with_plant(1, 3).make_loop("family")
    assert is_same(replace(run_episode(alone, 14, seed=1), plant=3), family[14])
    with pytest.raises(ValueError, match="plants: there 6, here 5"):
        run_episodes(scenario, 60, variation="family", plants=5, seed=1, path=tmp_path / "family")


def test_plants_are_held_out_as_a_whole(sets):
    nominal, family = sets
    parameters = AssessmentParameters()
    parameters = replace(parameters, horizon=nominal.info.horizon)
    parameters.preview_stride = nominal.info.preview_stride
    segments = training_segments(nominal.joined(family), parameters)
    is_held_out = held_out_segments(segments, parameters)
    for group in np.unique(segments.group):
        assert len(set(is_held_out[segments.group == group])) == 1
    plants = {-group for group in segments.group[is_held_out] if group < 0}
    assert 0 < len(plants) < 6 and (segments.group[is_held_out] >= 0).any()
    # Nominal episodes are held out as without a family.
    alone = training_segments(nominal, parameters)
    assert held_out_segments(alone, parameters).sum() == is_held_out[segments.group >= 0].sum()
    with pytest.raises(ValueError, match="differ in \\['step_s'\\]"):
        nominal.joined(type(family)(replace(family.info, step_s=0.05), []))


def test_gamma_learns_from_both_and_says_so(scenario, sets, tmp_path):
    nominal, family = sets
    parameters = replace(scenario.assessment, epochs=3, perplexity=10.0)
    gamma = SafetyAssessment(parameters).fit(nominal, family=family)
    assert gamma.knows_family
    assert [(one.purpose, one.num_episodes) for one in gamma.used_] == [
        ("training", 60),
        ("training on the family", 60),
    ]
    gamma.save(tmp_path / "sharpened.safetensors")
    for name, one_set, seed in (("episodes", nominal, 0), ("episodes_family", family, 1)):
        run_episodes(
            scenario, 60, variation=one_set.info.variation, seed=seed, path=tmp_path / name
        )
    loaded = SafetyAssessment.load(tmp_path / "sharpened.safetensors")
    learned = training_folder.training_episodes(tmp_path, loaded)
    assert [one.plant for one in learned] == [0] * 60 + [1 + i % 6 for i in range(60)]
    with pytest.raises(ValueError, match="'paper' learns from one plant"):
        SafetyAssessment(replace(parameters, mode="paper")).fit(nominal, family=family)


def test_the_temperature_makes_an_underconfident_logit_right(scenario, sets):
    nominal, family = sets
    gamma = SafetyAssessment(replace(scenario.assessment, epochs=3, perplexity=10.0)).fit(nominal)
    segments = split(family, stride=1, discount=1.0, shortest=1)
    right = gamma.temper(segments)
    before = gamma.predict_rows(segments).probability
    gamma.base_logit_ = gamma.base_logit_.at(2.0)
    assert gamma.temper(segments) == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(gamma.predict_rows(segments).probability, before, atol=0.01)
    assert 0.25 < right < 4.0


def test_check_simulates_the_family(scenario, tmp_path):
    (tmp_path / "one.yaml").write_text(scenario.to_yaml())
    findings = {one.item: one for one in check_scenario(tmp_path / "one.yaml", num_episodes=4)}
    finding = findings["share of unsafe episodes in the family"]
    assert "of 4 episodes, each on a random plant" in finding.message


def test_train_refuses_a_rare_entry_before_it_simulates(monkeypatch, capsys, tmp_path):
    scenario = load_scenario(
        "pendulum", {"family": {"ranges": {"foot_friction": {"share": 0.01, "one_of": [0.5]}}}}
    )
    (tmp_path / "one.yaml").write_text(scenario.to_yaml())
    assert call(monkeypatch, "train", tmp_path / "one.yaml", "--out", tmp_path / "run") == 2
    assert "foot_friction" in capsys.readouterr().out and not (tmp_path / "run").exists()


def test_promises_over_the_family_are_judged_on_fresh_plants(scenario, sets, tmp_path):
    nominal, family = sets
    parameters = replace(scenario.assessment, epochs=3, perplexity=10.0)
    gamma = SafetyAssessment(parameters).fit(nominal, family=family)
    rates = {"miss_rate": 0.1, "false_alarm_rate": 0.1, "confidence": None}
    label, score = np.arange(40) % 2 == 0, np.linspace(0.0, 1.0, 40)
    made = {"scenario_hash": nominal.info.scenario_hash, **rates}
    chosen = [calibrate(score, label, kind=PLAN, plants=plants, **made) for plants in (0, 40)]
    gamma.adopt_calibrations(chosen)
    evaluation = Evaluation(
        scenario, {"sharpened": gamma}, tmp_path, tmp_path, {"evaluation": 77}, 1, lambda *a: None
    )
    add_family(evaluation, 30)
    assert {key[0] for key in evaluation.estimates} == {"calibration.plan.family"}
    drawn = run_episodes(scenario, 30, variation="family", seed=77, plants=30, num_workers=1)
    missed = evaluation.estimates["calibration.plan.family", "sharpened", "miss_rate"]
    assert missed.n == drawn.num_unsafe
    assert {one.plant for one in drawn} == {*range(1, 31)}
