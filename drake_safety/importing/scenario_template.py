"""First scenarios for a new robot: the tasks' defaults, scaled to its size."""

from collections.abc import Sequence
from dataclasses import dataclass

from drake_safety.files.reading import yaml_text
from drake_safety.robots.robot_size import BALANCING_REFERENCE, RobotSize


@dataclass(frozen=True, kw_only=True)
class Sizes(RobotSize):
    """Sizes of a standing robot, as far as scenarios need them."""

    lateral_m: float  # Smallest distance of a foot from the midline.
    reach_m: float  # Length of an arm; 0 without arms.
    shoulder_m: list[float]  # Its first joint from the feet's centroid on the ground, (3,).
    base: str
    arm_joints: list[str]  # First joint of every arm.
    joint_friction_nm: float | None = None  # Median; None if the URDF has none.


def scenario_yaml(task: str, sizes: Sizes) -> str:
    """Writes the scenario of a task as commented YAML."""
    what = 'an alarm of the monitor makes every belief "don\'t know"; report: only says so'
    return TASKS[task](sizes) + f"on_alarm: unknown  # DECIDED {what}\n"


def _numbers(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:.3g}" for value in values) + "]"


def _variations(sizes: Sizes, mass_scale: float, position: float, velocity: float) -> str:
    if (friction := sizes.joint_friction_nm) is None:
        scale = sizes.factors(BALANCING_REFERENCE)
        friction = 0.4 * scale["mass"] * scale["height"]
    noise = f"{{position: {position:g}, velocity: {velocity:g}}}  # of your sensors [m, rad; 1/s]"
    reason = "Γ learns from the masses of the URDF"
    if mass_scale < 1:
        reason = "Γ learns from lighter links, a reality gap as in the paper; 1: the URDF's masses"
    load = _numbers([0.02 * sizes.mass_kg, 0.12 * sizes.mass_kg])
    return f"""family:  # random plants around the nominal one; Γ learns on them too
  ranges:  # ASK how widely your robot, its load and its ground differ; `check` says if it falls
    mass_scale: {{uniform: {_numbers([0.85 * mass_scale, 1.3 * mass_scale])}}}
    joint_friction_nm: {{uniform: {_numbers([0.0, 1.25 * friction])}}}  # [N·m]
    foot_friction: {{share: 0.5, log_uniform: [0.35, 1.0]}}  # in half of the plants
    payload: {{share: 0.3, mass_kg: {{uniform: {load}}}}}  # on the base [kg]
    shift:
      slope_rad: {{share: 0.5, uniform: [0.0, 0.08]}}  # of the ground [rad]
      slope_direction_rad: {{uniform: [-3.14, 3.14]}}
      joints: {{share: 0.3, .*: {{effort_scale: {{uniform: [0.8, 1.0]}}}}}}  # weaker motors
variations:
  nominal:  # the model that Γ is trained on
    mass_scale: {mass_scale:g}  # DECIDED {reason}
    input_noise: {noise}
  actual:  # ASK how the real robot differs from its URDF
    joint_friction_nm: {friction:.2g}  # dry friction of a joint [N·m]
    observation_noise: {noise}
"""


def _balancing(sizes: Sizes) -> str:
    scale = sizes.factors(BALANCING_REFERENCE)
    weak, strong = (
        f"mass_kg: {mass * scale['mass']:.3g}, speed_m_s: {speed * scale['speed_y']:.3g}"
        for mass, speed in ((2.0, 3.5), (3.0, 9.0))
    )
    arms = ""
    if sizes.arm_joints:
        joints = ", ".join(map(yaml_text, sizes.arm_joints))
        arms = f"""  arms:  # DECIDED a plant for --variation, whose arms turn while it balances
    shift: {{command_faults: [{{kind: drift, entries: [{joints}], value: 0.5}}]}}  # [rad/s]
"""
    return f"""# Balancing: {sizes.mass_kg:.1f} kg, a base {sizes.height_m:.3f} m high.
task: drake_safety.diagrams.balancing:Balancing
robot: robot.yaml
{_variations(sizes, 0.8, 0.004, 0.016)}{arms}parameters:
  # Safe heights, starts, plans, balls and steps are the task's defaults, scaled to the robot; what
  # is stated here replaces them, such as safe_set: {{height_m: [lowest, highest]}}.
  scale_to_robot: true
  push: {{share: 0.35}}  # of episodes that begin with the impact of a ball
  demonstration:  # ASK the balls of `run --push ball`: a weak one and a strong one, towards [rad]
    - {{time_s: 0.6, {weak}, direction_rad: 1.5708}}
    - {{time_s: 1.68, {strong}, direction_rad: -1.2}}
  recovery:
    threshold: 0.4  # of the probability, not tuned to this robot
    step:
      max_twist_rad: 0  # holds no heading; 0.3 does, if the feet do not slip under it [rad]
      min_lateral_m: {0.85 * sizes.lateral_m:.3g}  # of a foothold from the midline [m]
"""


def _reaching(sizes: Sizes) -> str:
    h, reach = sizes.height_m, sizes.reach_m
    x, y, z = sizes.shoulder_m
    low, high = y - 0.8 * reach, y + 0.8 * reach
    return f"""# Reaching: {sizes.mass_kg:.1f} kg, a base {h:.3f} m high, arms of {reach:.2f} m.
task: drake_safety.diagrams.reaching:Reaching
robot: robot.yaml
episode_duration_s: 4.0
step_s: 0.1
time_step_s: 0.002
control_period_s: 0.004
{_variations(sizes, 1.0, 0.0005, 0.01)}assessment:
  {{horizon: 30, shortest_segment: 5, raw_input_scale: 0.05, feature_unit: 0.02}}
parameters:
  start:
    base_lowering_m: {0.08 * h / 0.74:.3g}  # [m]
    joint_margin_rad: 0.02
  target:  # ASK the box that targets come from, in the world: x forwards, y left, z up [m]
    x_m: {_numbers([x + 0.3 * reach, x + 1.1 * reach])}
    y_m: {_numbers([low, high])}
    z_m: {_numbers([max(z - 0.7 * reach, 0.1), z + 0.6 * reach])}
  # ASK what stands in the way: a model file and where it is [m]
  # obstacles:
  #   - {{model: package://drake_safety_models/scenes/bookshelf.urdf, position: [0.95, 0.0, 0.0]}}
"""


def _walking(sizes: Sizes) -> str:
    h = sizes.height_m
    return f"""# Walking: {sizes.mass_kg:.1f} kg, a base {h:.3f} m high.
task: drake_safety.diagrams.walking:Walking
robot: robot.yaml
episode_duration_s: 4.0
step_s: 0.1
control_period_s: 0.02
{_variations(sizes, 1.0, 0.004, 0.016)}assessment: {{preview_stride: 1}}
parameters:
  policy: policy.yaml
  safe_set:  # ASK the least heights of bodies that must not touch the ground [m]
    clearance_m: {{{yaml_text(sizes.base)}: {0.35 * h:.2g}}}
  commands: {{reach: 3.0}}  # beyond the ranges of training, so that some episodes are unsafe
"""


TASKS = {"balancing": _balancing, "reaching": _reaching, "walking": _walking}
