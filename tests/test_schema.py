"""What a schema refuses: the key's path, what it has, what it may have, and what was meant."""

from dataclasses import dataclass, field

import pytest

from drake_safety.diagrams.balancing.parameters import BalancingParameters
from drake_safety.diagrams.reaching.parameters import ReachingParameters
from drake_safety.diagrams.walking.parameters import WalkingParameters
from drake_safety.files.reading import parse_yaml
from drake_safety.files.schema import load_typed, load_typed_file
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.calibration import Calibration
from drake_safety.logs.log_map import LogMap
from drake_safety.policies.policy import PolicyParameters
from drake_safety.robots.robot import PlantVariation
from drake_safety.robots.robot_model import RobotModel
from drake_safety.robots.shift import Fault
from drake_safety.simulation.scenario import Scenario


@dataclass(kw_only=True)
class Part:
    size: int = 3


@dataclass(kw_only=True)
class Task:
    """A user's, of the standard library."""

    part: Part = field(default_factory=lambda: Part(size=4))
    parts: dict[str, Part] = field(default_factory=dict)
    optional: Part | None = None
    speed: float = 1.0
    is_on: bool = False

    def __post_init__(self):
        if self.speed > 9:
            raise ValueError(f"speed must not exceed 9; got {self.speed}")


CASES = {
    Task: {
        "speeed: 1": r"^mine: unknown key 'speeed' \(did you mean 'speed'\?\); keys th.*'",
        "part: {sise: 1}": r"'part\.sise' \(did you mean 'size'\?\).*\['size'\]",
        "speed: fast, sped: 1": "unknown key 'sped'",
        "speed: 10.0": "^mine: speed must not exceed 9; got 10.0",
    },
    BalancingParameters: {
        "safe_set: {height_m: [0.5, 0.3]}": r"height_m' .* lowest < highest; got \[0.5, 0.3\]",
        "safe_set: {fall_height_m: 0.4}": "fall_height_m must not exceed 0.3; got 0",
        "recovery: {step: {min_steps: 5, max_steps: 3}}": "exceed max_steps; got 5, 3",
        "recovery: {step: {resume_margin_m: 0.09}}": "exceed settle_margin_m; got 0.09, 0.08",
    },
    RobotModel: {
        "joint_gains: {.*: {stiffnes: 3.0}}": r"s\.\.\*\.stiffnes'.*'stiffness'",
        "joint_gains: {.*: {stiffness: -20.0}}": r"\.stiffness' must be greater .* to 0; got -20",
        "effort_limits: {a: -1.0}": r"'effort_limits\.a' must be greater than 0; got -1",
        "velocity_limits: {a: 0.0}": r"'velocity_limits\.a' must be greater than 0; got 0",
        "rotor_inertia: {a: -1.0}": r"'rotor_inertia\.a' must be greater than or equal to 0",
        "mirror: {(: x}": r"'mirror\.\(' must be a regular expression: .*; got '\('",
        "shapes: {seat: [{}]}": r"'shapes\.seat\.0': expected box_m, or radius_m",
        "shapes: {a: [{radius_m: 1}]}": r"shapes \['a'\] need collision: stated",
    },
    PolicyParameters: {
        "history: {ages: [0, 2]}": r"newest 2 samples once; got \[0, 2\]",
        "history: {ages: [0, 1]}, observation: [{name: a, history: 2}]": r"got both, \['a'\]",
        "command: {lowest: [2, 0, 0]}": "'command': lowest must not exceed",
        "command: {change: [0, -1, 0]}": r"'command\.change\.1' must be greater .*; got -1",
        "gains: {a: {damping: .nan}}": r"'gains\.a\.damping' must be a finite number; got nan",
        "action_scale: {a: .nan}": r"'action_scale\.a' must be a finite number; got nan",
    },
    Scenario: {
        "step_s: 1e-9": "an episode of 2.0 s has more than 10000000 steps of step_s",
        "on_alarm: stop": "'on_alarm' must be 'unknown' or 'report'; got 'stop'",
        "assessment: {horizon: 51}": "horizon of 51 steps .* exceeds the episode",
    },
    PlantVariation: {
        "shift: {slope_rad: 2.0}": r"shift\.slope_rad' must be less than 1\.57.*; got 2.0",
    },
    Fault: {
        "kind: scael, value: 1.0": r"'kind' must be 'bias', .*mean 'scale'\?\); got",
        "kind: delay": "'delay' needs a value; got None",
        "kind: zero, value: 1.0": "'zero' has no value; got 1.0",
        "kind: delay, value: -1.0": "value of 'delay' must not be negative; got -1.0",
    },
    ReachingParameters: {
        "pushes: {a: {force_n: [1.0, 2.0, .nan]}}": r"a\.force_n\.2' .* finite number; got nan",
    },
    WalkingParameters: {
        "safe_set: {fall_tilt_rad: 0.5}": "tilt_rad must not exceed fall_tilt_rad",
        "safe_set: {height_share: 0.3}": "fall_height_share <= height_share < 1",
    },
    AssessmentParameters: {
        "discount: .nan": "'discount' must be .*; got nan",
        "shortest_segment: 11": "shortest_segment 11 exceeds the horizon",
    },
    Calibration: {"kind: walk": "'kind' must be 'plan' or 'motion'; got 'walk'"},
    LogMap: {
        "base_position: {columns: [a, b]}": "'base_position': columns must be 3 names",
        "base_position: {columns: [a, b, c]}, base_orientation: {columns: [a, b, c, d]}, "
        "base_linear_velocity: {columns: [a, b, c, d, e, f]}": "linear.* 3 names; got 6: ",
        "joint_positions: {template: q_}": "'joint_positions': template must contain",
        "joint_positions: {template: 'q_{joint}'}": ".columns' is missing; a state estimator",
    },
}


@pytest.mark.parametrize(
    ("schema", "text", "message"),
    [(schema, *case) for schema, cases in CASES.items() for case in cases.items()],
)
def test_document_that_does_not_fit_is_refused_with_what_would(schema, text, message):
    raw = parse_yaml(f"{{{text}}}", "the text")
    with pytest.raises(ValueError, match=message):
        load_typed(schema, raw, "mine")
    if schema not in (Task, LogMap, Calibration):  # The last two need more than is said.
        with pytest.raises(ValueError):
            schema(**raw)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed: fast", "'speed' must be a valid number; got 'fast'"),
        ("is_on: 1", "'is_on' must be a valid boolean; got 1"),
        ("part: {size: '3'}", r"'part\.size' must be a valid integer; got '3'"),
        ("3", r"this must be a mapping with keys of \['part', .*; got 3"),
        ("? 2020-01-01\n: 1", "keys must be str"),
    ],
)
def test_value_of_another_type_is_not_converted(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        load_typed_file(Task, path, f"task file '{path}'")
    assert str(error.value).startswith(f"task file '{path}': ")
    with pytest.raises(ValueError, match="other' does not exist"):
        load_typed_file(Task, tmp_path / "other", "task file 'other'")


def test_what_a_document_leaves_out_is_as_by_default(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("{speed: 1e-3, parts: {a: {}}, optional: {}}")
    read = load_typed_file(Task, path, "mine")
    assert read == Task(speed=1e-3, parts={"a": Part()}, optional=Part())
    assert load_typed(Task, {"part": {}, "speed": 2}, "mine") == Task(speed=2.0)
    assert type(load_typed(Task, {"speed": 2}, "mine").speed) is float
    assert load_typed(Task, {"part": {"size": 1}}, "mine").part.size == 1


def test_key_without_default_must_be_stated():
    @dataclass(kw_only=True)
    class Strict:
        size: int

    assert load_typed(Strict, {"size": 2}, "mine").size == 2
    with pytest.raises(ValueError, match=r"^mine: 'size' is missing$"):
        load_typed(Strict, {}, "mine")
