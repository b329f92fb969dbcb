import dataclasses
import inspect
from itertools import combinations

import pytest
import typer

from drake_safety import __version__
from drake_safety.cli import adapt, calibrate, gate, play, pushes, rate, run, train
from drake_safety.evaluation.episode_study import evaluate_episodes
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.learning import seeds
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.feedback import pair_episodes
from drake_safety.learning.seeds import NOT_DRAWN, RELEASE, UsedEpisodes, check_unused, use_of
from drake_safety.learning.segments import Episodes
from lip_assessments import calibration, quick_assessment, quick_episodes
from lip_episodes import make_episodes
from studies.__main__ import app as studies

BLOCKS = [block for block in vars(seeds).values() if isinstance(block, seeds.SeedBlock)]


def used(seed, purpose="training", num_episodes=7):
    info = dataclasses.replace(make_episodes(1).info, seed=seed)
    return UsedEpisodes.of(purpose, info, num_episodes)


def paired(seed, num=12):
    nominal = make_episodes(num, seed=seed, noise=0.002)
    actual = Episodes(dataclasses.replace(nominal.info, variation="actual"), list(nominal))
    return pair_episodes(actual, nominal)


def calibrated(assessment, seed):
    assessment.adopt_calibrations([calibration()], make_episodes(20, seed=seed))


@pytest.fixture
def assessment():
    return quick_assessment("sharpened")


def test_no_two_purposes_have_a_seed_in_common_whatever_their_sizes():
    drawn = [seed for block in BLOCKS for seed in block.seeds().values()]
    assert len(drawn) == len(set(drawn))
    for one, other in combinations(BLOCKS, 2):
        least = 100_000 if seeds.FRESH_MOTION in (one, other) else 1_000_000
        assert abs(one.first - other.first) >= least


def test_the_seeds_of_a_release_are_far_from_those_of_development():
    highest = max(seed for block in BLOCKS for seed in block.seeds().values())
    assert highest + 1_000_000 < RELEASE
    assert use_of(highest) == use_of(0) == "development"
    for block in (seeds.SHIFTS, seeds.FRESH_MOTION):
        assert use_of(block.first + RELEASE) == f"release {__version__.removesuffix('.dev0')}"
        assert block.first_beside(seeds.SHIFTS.first) == block.first
        assert block.first_beside(seeds.SHIFTS.first + RELEASE) == block.first + RELEASE


def test_every_command_takes_its_default_seed_from_the_table():
    blocks = {train.train: seeds.TRAINING, calibrate.calibrate: seeds.CALIBRATION}
    blocks |= {adapt.adapt: seeds.ADAPTATION, gate.gate: seeds.GATE, rate.rate: seeds.RATE}
    blocks |= {pushes.pushes: seeds.PUSHES}
    blocks |= dict.fromkeys((run.run, play.play), seeds.DEMONSTRATION)
    for command, block in blocks.items():
        assert inspect.signature(command).parameters["seed"].default == block.first


def test_every_study_with_seeds_has_those_of_the_release():
    for name, command in typer.main.get_command(studies).commands.items():
        options = {parameter.name for parameter in command.params}
        assert ("seed" in options or name == "walking") == ("release" in options), name


def test_a_used_seed_is_refused_with_what_it_was_used_for_and_one_that_is_free():
    spent = [used(3), used(5, "calibration", 9), used(NOT_DRAWN, "adaptation")]
    check_unused(spent, (0, 1, 2, 4, NOT_DRAWN), "who")
    with pytest.raises(ValueError, match=r"^who: seed 3 .* the 7 'nominal' episodes of its train"):
        check_unused(spent, (3,), "who")
    with pytest.raises(ValueError, match=r"seed 5 .* 9 'nominal' .* calibration; .* such as 6$"):
        check_unused(spent, (4, 5), "who")


@pytest.mark.train
def test_an_assessment_knows_all_that_it_was_learned_calibrated_and_adapted_with(
    assessment, tmp_path
):
    calibrated(assessment, 30)
    adapted = assessment.adapt(paired(40))
    assert [(u.purpose, u.variation, u.seed, u.num_episodes) for u in adapted.used_] == [
        ("training", "nominal", 0, len(quick_episodes())),
        ("calibration", "nominal", 30, 20),
        ("adaptation", "actual", 40, 12),
        ("adaptation", "nominal", 40, 12),
    ]
    adapted.save(tmp_path / "gamma")
    assert SafetyAssessment.load(tmp_path / "gamma").used_ == adapted.used_
    # Others take the place of what has gone; what has been learned from stays.
    calibrated(adapted, 31)
    again = adapted.adapt(paired(40) + paired(41))
    assert [one.seed for one in again.used_] == [0, 31, 40, 41, 40, 41]
    for seed in (0, 31, 40, 41):
        with pytest.raises(ValueError, match=f"seed {seed} gives"):
            again.check_unused(seed)
    again.check_unused(30)


@pytest.mark.train
def test_what_has_been_used_otherwise_is_neither_calibrated_nor_adapted_with(assessment):
    with pytest.raises(ValueError, match="episodes of its training"):
        assessment.adapt(paired(0))
    with pytest.raises(ValueError, match="episodes of its training"):
        calibrated(assessment, 0)
    calibrated(assessment, 30)
    with pytest.raises(ValueError, match="episodes of its calibration"):
        assessment.adapt(paired(30))
    with pytest.raises(ValueError, match="episodes of its adaptation"):
        calibrated(assessment.adapt(paired(40)), 40)


@pytest.mark.train
def test_who_is_judged_has_not_seen_the_episodes(assessment):
    calibrated(assessment, 30)
    gamma = assessment_scorer("gamma", assessment)
    fresh = make_episodes(20, seed=5)
    for other, test in ((fresh, make_episodes(20, seed=30)), (make_episodes(20), fresh)):
        with pytest.raises(ValueError, match=r"'gamma': seed \d+ gives"):
            evaluate_episodes([gamma], other, test)
    stranger = Scorer(name="stranger", probability=gamma.probability)
    evaluate_episodes([stranger], make_episodes(20, seed=30), fresh)
