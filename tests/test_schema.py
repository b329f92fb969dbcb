"""What a schema refuses: the key's path, what it has, what it may have, and what was meant."""

from dataclasses import dataclass, field

import pytest

from drake_safety.diagrams.balancing.parameters import BalancingParameters
from drake_safety.diagrams.pendulum.task import PendulumParameters
from drake_safety.diagrams.reaching.parameters import ReachingParameters
from drake_safety.diagrams.walking.parameters import WalkingParameters
from drake_safety.files.reading import parse_yaml
from drake_safety.files.schema import load_typed, load_typed_file
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.calibration import Calibration
from drake_safety.logs.log_map import LogMap
from drake_safety.logs.sequences import SequenceMap
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
        "parts: {a: {x: 1}}": r"unknown key 'parts\.a\.x'; keys there are \['size'\]",
        "optional: {sise: 1}": r"'optional\.sise' \(did you mean 'size'\?\)",
        "speed: fast, sped: 1": "unknown key 'sped'",
        "part: 3": r"'part' must be a mapping with keys of \['size'\]; got 3",
        "speed: 10.0": "^mine: speed must not exceed 9; got 10.0",
    },
    BalancingParameters: {
        "demonstration: [{mass: 3}]": r"demonstration\.0\.mass.*'mass_kg'",
        "push: {share: 2}": r"'push\.share' must be less than or .*; got 2",
        "safe_set: {height_m: 3}": r"'safe_set\.height_m' must be a valid",
        "demonstration: [{mass_kg: 0.0}]": r"0\.mass_kg' must be greater than 0; got 0.0",
        "demonstration: [{mass_kg: .nan}]": r"0\.mass_kg' must be a finite number; got nan",
        "demonstration: [{speed_m_s: -1.0}]": r"0\.speed_m_s' must be greater than 0; got -1.0",
        "safe_set: {height_m: [0.5, 0.3]}": r"height_m' .* lowest < highest; got \[0.5, 0.3\]",
        "safe_set: {height_m: [0.5]}": r"safe_set\.height_m' must have at least 2 items",
        "safe_set: {fall_height_m: 0.4}": "fall_height_m must not exceed .* height 0.3; got 0",
        "start: {base_height_m: [0.4]}": r"start\.base_height_m' must have at least 2 items",
        "start: {plan_duration_s: [2, 1]}": r"plan_duration_s' must be .*highest.; got \[2, 1\]",
        "start: {velocity_std_m_s: [0.1]}": r"start\.velocity_std_m_s' must have at least 3 items",
        "push: {mass_kg: [1, 2, 3]}": r"push\.mass_kg' must have at most 2.*; got \[1, 2, 3\]",
        "recovery: {step: {step_duration_s: 0.0}}": r"step_duration_s' must be gr.* 0; got 0.0",
        "recovery: {step: {lift_m: -1.0}}": r"step\.lift_m' must be greater than 0; got -1.0",
        "recovery: {step: {max_reach_m: .nan}}": r"step\.max_reach_m' .* finite number; got nan",
        "recovery: {step: {min_steps: 5, max_steps: 3}}": "exceed max_steps; got 5, 3",
        "recovery: {step: {min_steps: 0}}": r"step\.min_steps' must be greater than or equal to 1",
        "recovery: {step: {resume_margin_m: 0.09}}": "exceed settle_margin_m; got 0.09, 0.08",
        "recovery: {step: {max_twist_rad: -0.1}}": r"step\.max_twist_rad' must be gr.* 0; got -0.1",
    },
    RobotModel: {
        "foot_frictoin: 0.5": "unknown key 'foot_frictoin'.*foot_friction",
        "joint_gains: {.*: {stiffnes: 3.0}}": r"s\.\.\*\.stiffnes'.*'stiffness'",
        "foot_friction: -1.0": "'foot_friction' must be greater than 0; got -1",
        "whole_body: {com: {}}": r"unknown key 'whole_body\.com'.*'center_of_mas",
        "whole_body: {reaching: {wieght: 1}}": r"'whole_body\.reaching\.wieght'",
        "whole_body: {posture: {damping: .nan}}": r"'whole_body\.posture\.damping'",
        "whole_body: {orientation: {a: {weight: -1}}}": r"n\.a\.weight' must .*; got -1",
        "whole_body: {friction: 0.0}": r"'whole_body\.friction' must be greater than 0; got 0",
        "reaching_frames: {left: {bodie: x}}": r"'reaching_frames\.left\.bodie'.*'body'",
        "reaching_frames: {left: {point: [0, 1]}}": r"left\.point' must have at least 3 items.*; g",
        "reaching_frames: {left: {radius_m: -1.0}}": r"left\.radius_m' must be greater than or equ",
        "feet: {left: {contact_points: [[0.0, 0.1]]}}": r"'feet\.left\.contact_points\.0' must hav",
        "feet: {left: {}}": r"'feet\.left\.contact_points' is missing",
        "mirror: {(: x}": r"'mirror\.\(' must be a regular expression: .*; got '\('",
        "shapes: {seat: [{}]}": r"'shapes\.seat\.0': either box_m or a positive rad",
        "shapes: {seat: [{box_m: [1, 1, 1], to_m: [0, 0, 0]}]}": "a capsule's other end, away",
        "shapes: {a: [{radius_m: 1}]}": r"shapes \['a'\] need collision: stated",
        "collision: meshes": "'collision' must be 'model_file' or 'stated'; got 'm",
    },
    PolicyParameters: {
        "history: {ages: [0, 2]}": r"newest 2 samples once, from 0; got \[0, 2\]",
        "history: {by: joint}": r"history\.by' must be 'time' or 'term'; got 'joint'",
        "history: {ages: [0, 1]}, observation: [{name: a, history: 2}]": r"got both, \['a'\]",
        "observation: [{history: 0}]": r"observation\.0\.history' must be gr",
        "observation: [{clip: 0.0}]": r"'observation\.0\.clip' must be greater than 0; got",
        "period_s: 0.0": "'period_s' must be greater than 0; got 0",
        "action_clip: .nan": "'action_clip' must be greater than 0; got nan",
        "command: {lowest: [2, 0, 0]}": "'command': lowest must not exceed",
        "command: {change: [1, 2]}": r"'command\.change' must have at least 3 items",
    },
    Scenario: {
        "step_s: 0": "'step_s' must be greater than 0; got 0",
        "step_s: .nan": "'step_s' must be a finite number; got nan",
        "step_s: 1e-9": "step_s is 1e-09, so that an episode of 2.0 s has more than 10000000 steps",
        "control_period_s: 1.0e-9": "has more than 10000000 steps",
        "time_step_s: 1.0e-8": "has more than 10000000 steps",
        "on_alarm: stop": "'on_alarm' must be 'unknown' or 'report'; got 'stop'",
        "assessment: {horizon: 1.5}": r"'assessment\.horizon' must be a valid integer",
        "assessment: {horzon: 3}": r"horzon' \(did you mean 'horizon'\?\)",
        "assessment: {horizon: 51}": "horizon of 51 steps .* exceeds the episode",
        "variations: {a: {mass_scale: -1}}": r"a\.mass_scale' must be greater than 0; got -1",
    },
    PlantVariation: {
        "engine: bullet": "'engine' must be 'drake' or 'mujoco'; got 'bullet'",
        "foot_friction: -0.1": "'foot_friction' must be greater than 0; got -0.1",
        "joint_friction_nm: -1.0": "'joint_friction_nm' must be greater than or equal to 0; got -1",
        "joint_damping: .nan": "'joint_damping' must be",
        "payload: {mass_kg: 0.0}": r"payload\.mass_kg' must be greater than 0; got 0.0",
        "payload: {position_m: [0.0, 1.0]}": r"payload\.position_m' must have at least 3 items",
        "shift: {slope_rad: 2.0}": r"shift\.slope_rad' must be less than 1\.57.*; got 2.0",
        "shift: {base_force_n: [1.0]}": r"shift\.base_force_n' must have at least 3 items",
        "shift: {command_delay_s: -1.0}": r"shift\.command_delay_s' must be gr.* 0; got -1.0",
        "shift: {holes_m: {FR: 0.0}}": r"shift\.holes_m\.FR' must be greater than 0; got 0.0",
        "shift: {joints: {a: {effort_scale: 0.0}}}": r"a\.effort_scale' must be gr.* 0; got 0.0",
        "shift: {joints: {a: {damping_scale: -1.0}}}": r"damping_scale' must be gr.* 0; got -1.0",
    },
    Fault: {
        "kind: noize, value: 1.0": r"'kind' must be 'bias', .*mean 'noise'\?\); got",
        "kind: noise": "'noise' needs a value; got None",
        "kind: swap, value: 1.0": "'swap' has no value; got 1.0",
        "kind: delay, value: -1.0": "value of 'delay' must not be negative; got -1.0",
        "kind: bias, value: .nan": "'value' must be a finite number; got nan",
        "start_s: -1.0": "'start_s' must be greater than or equal to 0; got -1.0",
    },
    ReachingParameters: {
        "view: {elevation_rad: 1.6}": r"view\.elevation_rad' must be less than 1\.57.*; got 1.6",
        "view: {room: 0.0}": r"view\.room' must be greater than 0; got 0.0",
        "obstacles: [{position: [0.0, 1.0]}]": r"position' must .* 3.* got \[0.0, 1.0\]",
        "obstacles: [{position: [0.0, 1.0, .nan]}]": r"0\.position\.2' .* finite number; got nan",
        "obstacles: [{yaw_rad: .inf}]": r"0\.yaw_rad' must be a finite number; got inf",
        "pushes: {a: {force_n: [1.0, 2.0]}}": r"force_n' must .* least 3 items.*; got \[1.0, 2.0\]",
        "pushes: {a: {force_n: [1.0, 2.0, .nan]}}": r"a\.force_n\.2' .* finite number; got nan",
        "pushes: {a: {time_s: -0.1}}": r"a\.time_s' must be greater than or equal to 0; got -0.1",
        "pushes: {a: {duration_s: 0.0}}": r"a\.duration_s' must be greater than 0; got 0.0",
        "random_pushes: {share: 1.0}": r"random_pushes\.share' must be less than 1; got 1.0",
        "random_pushes: {force_n: [2.0, 1.0]}": r"force_n' must be .*highest.; got \[2.0, 1.0\]",
        "random_pushes: {time_s: [1.0]}": r"random_pushes\.time_s' must have at least 2 items",
        "random_pushes: {time_s: [-1.0, 1.0]}": r"random_pushes\.time_s\.0' must be gr.* 0; got",
        "random_pushes: {duration_s: 0.0}": r"random_pushes\.duration_s' must be gr.* 0; got 0.0",
        "safe_set: {joint_margin_rad: -0.1}": r"joint_margin_rad' must be gr.* 0; got -0.1",
        "safe_set: {joint_margin_rad: .nan}": r"joint_margin_rad' .* finite number; got nan",
        "safe_set: {support_clearance_m: -0.01}": r"support_clearance_m' must be gr.* 0; g",
        "safe_set: {fall_height_share: 1.0}": r"fall_height_share' must be less than 1; got 1",
        "safe_set: {fall_tilt_rad: 0.0}": r"safe_set\.fall_tilt_rad' must be gr.* 0; got 0.0",
        "safe_set: {fall_tilt_rad: 4.0}": r"fall_tilt_rad' must be less than 3.14.*; got 4.0",
        "start: {base_offset_m: [0.1]}": r"start\.base_offset_m' must have at least 2 items",
        "start: {base_offset_m: [0.1, -0.1]}": r"start\.base_offset_m\.1' must be gr.* 0; got",
        "start: {tilt_rad: -0.1}": r"start\.tilt_rad' must be greater than or equal to 0; got -0.1",
        "start: {clearance_m: .nan}": r"start\.clearance_m' must be a finite number; got nan",
        "target: {x_m: [1.0, 1.0]}": r"x_m' .* lowest < highest; got \[1.0, 1.0\]",
        "target: {z_m: [0.0, .inf]}": r"target\.z_m\.1' must be a finite number; got inf",
        "detours: {share: 1.0}": r"detours\.share' must be less than 1; got 1.0",
        "detours: {lowest_m: [0.1, 0.0, 0.0]}": r"lowest_m must not exceed highest_m; got \[0.1, 0",
        "detours: {lowest_m: [0.1]}": r"detours\.lowest_m' must have at least 3 items",
        "plan_duration_s: 0.0": "'plan_duration_s' must be greater than 0; got 0.0",
        "monitor_period_s: -1.0": "'monitor_period_s' must be greater than 0; got -1.0",
        "clearance_range_m: 0.01": "start.clearance_m must not exceed clearance_range_m.*0.01; got",
        "named_targets: {can: [0.5, 0.1]}": r"'named_targets\.can' must have at least 3 items.*; g",
    },
    WalkingParameters: {
        "safe_set: {tilt_rad: 0.0}": r"safe_set\.tilt_rad' must be greater than 0; got 0.0",
        "safe_set: {fall_tilt_rad: 0.5}": "tilt_rad must not exceed fall_tilt_rad; got 0.7, 0.5",
        "safe_set: {height_share: 0.3}": "fall_height_share <= height_share < 1; got 0.45, 0.3",
        "recovery: {branch: jump}": r"recovery\.branch' must be 'stop' or 'slower'; got 'jump'",
        "start: {push_share: 1.1}": r"start\.push_share' must be less than or equal to 1; got 1.1",
        "start: {walked_s: [2.0, 1.0]}": r"walked_s' must be \[lowest, highest\]; got \[2.0, 1.0\]",
        "commands: {reach: 0.0}": r"commands\.reach' must be greater than 0; got 0.0",
        "commands: {num_segments: [0, 1]}": r"commands\.num_segments\.0' must be gr.* 1; got 0",
    },
    PendulumParameters: {
        "effort_share: 1.2": "'effort_share' must be less than 1; got 1.2",
        "mass_kg: 0": "'mass_kg' must be greater than 0; got 0",
        "plan_duration_s: [2, 1]": r"'plan_duration_s' must be \[lowest, highest\]",
        "start_angle_rad: 0.9": "exceed largest_angle_rad 0.6.*; got 0.9",
    },
    AssessmentParameters: {
        "mode: blunt": "'mode' must be 'sharpened' or 'paper'; got 'blunt'",
        "distance_backend: fast": "'distance_backend' must .*tslearn",
        "exaggeration: 0.5": "'exaggeration' must be greater than .* 1; got 0",
        "discount: 1.1": "'discount' must be less than or equal to 1; got 1.1",
        "discount: .nan": "'discount' must be .*; got nan",
        "initial_uncertainty: -0.1": "'initial_uncertainty' must be greater than or equal to 0; go",
        "min_count: 0": "'min_count' must be greater than or equal to 1",
        "cell_length: 0.0": "'cell_length' must be greater than 0; got",
        "dropout: 1.0": "'dropout' must be less than 1; got 1.0",
        "novelty_rate: 0.0": "'novelty_rate' must be greater than 0; got",
        "hidden_sizes: []": "'hidden_sizes' must have at least 1 item",
        "hidden_sizes: [0]": r"'hidden_sizes\.0' must be greater .* 1; got 0",
        "margin_range: [0.1, -0.1]": r"'margin_range' must be \[lowest, highest\], lowest < hig",
        "raw_input_scale: 0.0": "'raw_input_scale' must be greater than 0; got",
        "feature_unit: -1.0": "'feature_unit' must be greater than or equal to 0; got",
        "shortest_segment: 11": "shortest_segment must not exceed horizon 10",
        "paper: {stride: -1}": r"'paper\.stride' must be greater than or equal to 0; got -1",
        "paper: {hidden_sizes: []}": r"'paper\.hidden_sizes' must have at",
        "adaptation: {gate: -1.0}": r"'adaptation\.gate' must be greater than or equal to 0; got",
        "adaptation: {least_uncertainty: 1.1}": "least_uncertainty' must",
        "adaptation: {update_interval: 0}": "update_interval' must be gr",
        "adaptation: {offset_std: 0.0}": "offset_std' must be greater than 0; got",
        "adaptation: {slope_std: 0.0}": "slope_std' must be greater than 0; got",
    },
    Calibration: {"kind: walk": "'kind' must be 'plan' or 'motion'; got 'walk'"},
    LogMap: {
        "base_position: {columns: [a, b]}": "'base_position': columns must be 3 names",
        "base_position: {columns: [a, b, a]}": "names a column twice",
        "base_position: {unit: cm}": r"base_position\.unit' must be 'm' or 'mm'; got 'cm",
        "base_linear_velocity: {unit: deg}": r"y\.unit' must be 'm' or 'mm'; got 'deg'",
        "base_orientation: {order: zyxw}": r"n\.order' must be 'wxyz' or 'xyzw'",
        "base_orientation: {columns: [a, b, c]}": "columns must be 4 names",
        "time: {column: t, unit: h}": r"'time\.unit' must be 's', 'ms', 'us' or 'ns'",
        "joint_positions: {template: q_}": "'joint_positions': template must contain",
        "joints: {}": "unknown key 'joints'; keys there are",
        "max_gap_s: 0.0": "'max_gap_s' must be greater than 0; got 0.0",
        "joint_positions: {template: 'q_{joint}'}": ".columns' is missing: .* MUSE, Pronto or",
    },
    SequenceMap: {
        "step_s: -1.0": "'step_s' must be greater than or equal to 0; got -1.0",
        "scales: {}": r"unknown key 'scales' \(did you mean 'scale'\?\)",
    },
}


@pytest.mark.parametrize(
    ("schema", "text", "message"),
    [(schema, *case) for schema, cases in CASES.items() for case in cases.items()],
)
def test_a_document_that_does_not_fit_is_refused_with_what_would(schema, text, message):
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
        ("speed: [1]", r"'speed' must be a valid number; got \[1\]"),
        ("speed: true", "'speed' must be a valid number; got True"),
        ("is_on: 1", "'is_on' must be a valid boolean; got 1"),
        ("part: {size: '3'}", r"'part\.size' must be a valid integer; got '3'"),
        ("3", r"this must be a mapping with keys of \['part', .*; got 3"),
        ("? 2020-01-01\n: 1", "keys must be str"),
    ],
)
def test_a_value_of_another_type_is_not_converted(tmp_path, text, message):
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


def test_a_key_without_a_default_must_be_stated():
    @dataclass(kw_only=True)
    class Strict:
        size: int

    assert load_typed(Strict, {"size": 2}, "mine").size == 2
    with pytest.raises(ValueError, match=r"^mine: 'size' is missing$"):
        load_typed(Strict, {}, "mine")
