"""`ask` answers before anything moves, and `run --target` obeys, unless it is forced."""

import re

import numpy as np
import pytest

import command_line
from drake_safety.cli.run import alarm_times
from drake_safety.cli.training_folder import assessment_file
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import Calibration
from drake_safety.simulation.motion import Motion
from reaching_targets import CAUSE, FAR, NEAR, SCENARIO, learned_targets

pytestmark = pytest.mark.train


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a training, and what was trained: that targets beyond a plane are unsafe."""
    folder, assessment = tmp_path_factory.mktemp("reaching"), learned_targets()
    assessment.save(assessment_file(folder, "sharpened"))
    return folder, assessment


@pytest.fixture
def folder(trained, tmp_path):
    """A folder of one's own with that assessment."""
    assessment_file(tmp_path, "sharpened").symlink_to(assessment_file(trained[0], "sharpened"))
    return tmp_path


def calibrate(folder, threshold):
    """Chooses the threshold of the folder's assessment; just above one, nothing is accepted."""
    file = assessment_file(folder, "sharpened")
    assessment = SafetyAssessment.load(file)
    rates = {"miss_rate": 0.01, "false_alarm_rate": 0.05, "confidence": None}
    counts = {"num_unsafe": 99, "num_safe": 99, "num_missed": 0, "num_accepted": 9}
    chosen = {"threshold": threshold, "unsafe_below": threshold}
    kind = {"kind": "plan", "seed": 5, "scenario_hash": ""}
    assessment.calibrations_["plan"] = Calibration(**kind, **chosen, **rates, **counts)
    file.unlink()
    assessment.save(file)
    return assessment


@pytest.fixture
def call(monkeypatch, capsys):
    """A function: exit code and output of a command line."""
    return lambda *words: (command_line.call(monkeypatch, *words) or 0, capsys.readouterr().out)


@pytest.fixture
def ask(call, folder):
    return lambda *words: call("ask", SCENARIO, "--assessment", folder, *words)


def test_an_accepted_target_is_printed_with_its_belief_and_ends_with_zero(ask, folder):
    calibrate(folder, 0.4)
    code, printed = ask("--target", *NEAR)
    assert code == 0 and "nearest accepted" not in printed
    assert "0.6 0.5 1.05 m of the left hand" in printed
    assert re.search(r"verdict +safe: probability \d\.\d+ ≥ threshold 0\.400", printed)
    assert "belief" in printed
    assert "at most 1 % of unsafe episodes called safe" in printed
    # The answer first, the origin of Γ last.
    assert [line.split()[0] for line in printed.splitlines()] == [
        *("verdict", "target", "belief", "threshold"),
        "monitor:",
    ]


def test_a_refused_target_is_printed_with_its_cause_and_the_nearest_accepted_one(ask, folder):
    # A threshold beside the assessment is not believed.
    forged = Estimate.exact(-5.0, 100)
    Results({("plans", "sharpened", "threshold"): forged}).write(folder / "evaluation.json")
    code, printed = ask("--target", *FAR)
    assert code == 1
    because = rf"the constraint '{CAUSE}' would be violated by \d+\.\d cm"
    assert re.match(rf"verdict +unsafe: {because}\nnearest accepted ", printed)
    assert re.search(r"probability +\d\.\d+ < threshold 0\.500", printed)
    assert re.search(r"threshold +0\.500, the default, which promises nothing", printed)
    nearest = re.search(r"nearest accepted +(\S+ \S+ \S+) m, \S+ cm away", printed)[1]
    # The printed target can be typed, and is accepted then.
    assert ask("--target", *nearest.split())[0] == 0
    assert float(nearest.split()[0]) < FAR[0]
    assert float(re.search(r"cm away, probability (\S+)", printed)[1]) >= 0.5 + 0.8 * 0.5


def test_outside_the_region_the_answer_is_the_region_and_ends_with_one(ask, folder):
    calibrate(folder, 0.0)
    code, printed = ask("--target", 0.7, -0.9, 1.0)
    assert code == 1
    assert "don't know: the target is outside the region sampled in training" in printed
    assert "x 0.45…1, y -0.3…1.3, z 0.5…1.6 m" in printed
    # The region of the other hand is the mirrored one.
    assert ask("--target", NEAR[0], -NEAR[1], NEAR[2], "--hand", "right")[0] == 0


def test_an_answer_takes_none_of_the_packages_that_training_takes(folder):
    code = (
        "import sys\n"
        "from drake_safety.cli import main\n"
        "sys.argv = ['drake-safety', *sys.argv[1:]]\n"
        "try:\n    main()\n"
        "finally:\n    print(*{name.partition('.')[0] for name in sys.modules})\n"
    )
    words = ("ask", SCENARIO, "--assessment", folder, "--target", *NEAR)
    loaded = set(command_line.python("-c", code, *words).splitlines()[-1].split())
    assert "pydrake" in loaded
    heavy = {"torch", "dtaidistance", "openTSNE", "sklearn", "matplotlib", "numba"}
    heavy |= {"pandas", "pyarrow", "joblib", "tensorboard"}
    assert loaded & heavy == set()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("ask --target green_ball", "'green_ball': give x y z"),
        ("ask --target blue_box --hand third", "no reaching frame 'third'; it has ['left'"),
        ("run --target blue_box --push ball", "--push: expected one of ['torso']"),
        ("run --target blue_box --no-recovery", "no options ['recovery']; it has ['hand', 'ex"),
    ],
)
def test_what_does_not_exist_is_answered_with_what_does(call, folder, arguments, message):
    command, *options = arguments.split()
    code, printed = call(command, SCENARIO, "--assessment", folder, *options)
    assert code == 2 and message in printed
    assert not (folder / "run").exists()


def test_a_run_obeys_a_refusal(call, folder, monkeypatch):
    # The search for an accepted target takes long.
    monkeypatch.setattr("drake_safety.cli.ask.nearest_accepted_goal", lambda *_, **options: None)
    calibrate(folder, 1.0 + 1e-6)
    code, printed = call("run", SCENARIO, "--assessment", folder, "--target", "red_can")
    assert code == 1
    assert "refused: nothing moved; --force goes there" in printed
    assert not (folder / "run").exists()


def test_a_run_goes_where_it_is_let(call, folder, monkeypatch):
    calibrate(folder, 0.0)
    saved = []
    monkeypatch.setattr("drake_safety.cli.run._save", lambda *shown: saved.append(shown))
    options = ("--assessment", folder, "--target", *NEAR, "--duration", 0.1)
    assert call("run", SCENARIO, *options)[0] == 0
    ((*_, shown),) = saved
    assert shown.motion.time_s[-1] == pytest.approx(0.1)
    assert np.ptp(shown.motion["output"], axis=0).max() > 0.0
    assert shown.events[0][0] == 0.0 and shown.events[-1][0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("gamma", "rows"),
    [
        ([0.9, 0.6, 0.4, 0.8], [2]),
        ([0.9, 0.5, 0.7], []),
        ([0.4, 0.9, 0.3], []),
        ([0.9, np.nan, 0.3], [1]),
    ],
)
def test_the_alarm_is_the_first_fall_of_a_gamma_that_was_accepted(gamma, rows):
    motion = Motion(time_s=np.arange(len(gamma)), ports={"safety_probability": np.array([gamma]).T})
    assert alarm_times(motion, 0.5) == rows
