"""What every system promises: its ports, which may be left open, what feeds through, and NaN."""

import inspect
import re

import numpy as np
import pytest
from pydrake.systems.framework import PortDataType
from pydrake.trajectories import PiecewisePolynomial

import system_block
from drake_safety import load_assessment
from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.control.safe_sets import BalanceLimits, BalanceSafeSet
from drake_safety.diagrams.pendulum.task import (
    PendulumController,
    PendulumObserver,
    PendulumParameters,
    PendulumSafeSet,
)
from drake_safety.diagrams.walking.safe_set import WalkingLimits, WalkingSafeSet
from drake_safety.robots.robot import ObservationNoise
from drake_safety.robots.shift import Fault
from drake_safety.systems.assessor_inputs import AssessorInputs
from drake_safety.systems.change_monitor import ChangeMonitor
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor
from drake_safety.systems.recovery_step_planner import RecoveryStepPlanner
from drake_safety.systems.recovery_switch import RecoverySwitch
from drake_safety.systems.recovery_trigger import RecoveryTrigger
from drake_safety.systems.safety_assessor import SafetyAssessor
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.sensor_faults import SensorFaults
from drake_safety.systems.state_observer import StateObserver
from drake_safety.systems.trajectory_planner import TrajectoryPlanner
from drake_safety.systems.whole_body_controller import WholeBodyController
from legged_robots import ROBOT_NAMES, robot_kinematics
from system_doubles import INFO, AssessmentDouble, Bench, SlowIsSafe, controller, guard

PERIOD = {"period_s": 0.01}
LATE = PERIOD | {"offset_s": 0.002}
ROWS = PERIOD | {"horizon": 4, "num_outlook": 3}
FAULTS = [Fault(kind="delay", value=0.2), Fault(kind="half_rate")]
LIMITS = BalanceLimits()
STEPS = RecoveryStepParameters(min_steps=1, max_steps=1)
LEARNED = load_assessment("laikago_balancing")
N_S, N_F = len(LEARNED.info_.state_names), len(LEARNED.info_.feature_names)
N_C, N_P = len(LEARNED.info_.constraint_names), 3 * LEARNED.info_.horizon
SEEN = f"state {N_S}, desired_preview {N_P}, features {N_F}"
PLAN = "desired_output 3, desired_preview 12, desired_outlook 9"
ALARM = f"alarm 1, levels {N_S}, alarm_cause -, judged_share 1"
BELIEF = "safety_probability 1, belief 3, embedding 2, novelty 1, fall_probability 1, "
BELIEF += "probability_without_alarm 1, belief_without_alarm 3, "
BELIEF += "cause_probability {0}, predicted_margins {0}, learned -"
# Ports with their sizes; `?`: may be left open; `<`: of these inputs, or of all of them, at once.
CASES = {
    "SensorFaults": (
        lambda: SensorFaults(["a", "b"], FAULTS, **PERIOD),
        "input 2 -> output 2 < *",
    ),
    "RecoveryTrigger": (
        lambda: RecoveryTrigger(**PERIOD),
        "safety_probability 1, belief? 3, recovery_done? 1 -> recovery_active 1, port_selector -",
    ),
    "TrajectoryPlanner": (
        lambda: TrajectoryPlanner(
            horizon=7, step_s=0.1, plan=PiecewisePolynomial(np.zeros((3, 1)))
        ),
        "stance_pose? 3 -> desired_output 3 < *, desired_output_rate 3 < *, "
        "desired_preview 21, desired_outlook 15",
    ),
    "SafetyAssessor": (
        lambda: SafetyAssessor(AssessmentDouble(), **PERIOD),
        f"state 2, desired_preview 6, features 3, margins 2, alarm 1 -> {BELIEF.format(2)} < alarm",
    ),
    "ChangeMonitor": (lambda: ChangeMonitor(LEARNED), f"{SEEN}, hold? 1 -> {ALARM}"),
    "MonitoredSafetyAssessor": (
        lambda: MonitoredSafetyAssessor(LEARNED),
        f"{SEEN}, margins {N_C}, hold? 1 -> {BELIEF.format(N_C)}, {ALARM}",
    ),
    "CommandGuard": (
        lambda: guard(SlowIsSafe()),
        f"command 3, state 1, features 3, learned? - -> {PLAN}, is_changed 1, safety_probability 1",
    ),
    "FeedbackRecorder": (
        lambda: FeedbackRecorder(
            INFO, num_steps=5, plant_state_size=2, watch_period_s=0.01, controller_memory_size=4
        ),
        "state 1, true_state? 1, output 3, desired_output 3, desired_preview 9, features 1, "
        "margins 2, safe 1, plant_state 2, controller_memory 4, recovery_active? 1 -> "
        "num_finished 1 < *",
    ),
    "PolicyController": (
        controller,
        "plant_state 17, command 3 -> desired_joint_state 4, action_state 10, status 1, "
        "num_failures 1, memory 28",
    ),
    "PendulumObserver": (
        lambda: PendulumObserver(0.5, PendulumSafeSet(PendulumParameters(), 0.05)),
        "pendulum_state 2, desired_outlook 123 -> plant_state 2 < pendulum_state, "
        "output 3 < pendulum_state, features 14 < *",
    ),
    "PendulumController": (
        lambda: PendulumController(PendulumParameters(), 0.01),
        "plant_state 2, desired_output 3, desired_output_rate 3 -> torque 1",
    ),
}


def add_robot(name):
    k = robot_kinematics(name)
    n_q, n_v, n_j = k.num_positions, k.num_velocities, k.num_joints
    x, feet = f"plant_state {n_q + n_v}", 3 * k.num_contacts
    safe_set = BalanceSafeSet(k, BalanceLimits())
    stance = f"desired_foot_positions {feet}, desired_yaw 1, stance_pose 3"
    ends = [f"nominal_{port}" for port in PLAN.split(", ")]
    switched = [
        f"{one} < {end.split()[0]}" for one, end in zip(PLAN.split(", "), ends, strict=True)
    ]
    for make, text in (
        (
            lambda: StateObserver(k),
            f"{x}, noise? {2 * n_v} -> measured_{x} < *, state {12 + 2 * n_j} < *, output 3 < *",
        ),
        (
            lambda: InverseKinematicsController(k, np.full(n_j, 250.0), **LATE),
            f"{x}, desired_output 3, desired_foot_positions? {feet}, desired_yaw? 1 -> "
            f"desired_joint_state {2 * n_j}",
        ),
        (
            lambda: WholeBodyController(k, **LATE),
            f"{x}, desired_output? 3, desired_output_rate? 3 -> "
            f"actuation {n_j}, solver_status 1, num_failures 1",
        ),
        (
            lambda: RecoveryStepPlanner(k, STEPS, **ROWS),
            f"{x}, recovery_active 1, {ends[0]} -> {PLAN}, {stance}, recovery_done 1",
        ),
        (
            lambda: RecoverySwitch(k, STEPS, threshold=0.6, offset_s=0.0005, **ROWS),
            f"{x}, safety_probability 1, belief? 3, {', '.join(ends)} -> "
            f"{', '.join(switched)}, {stance}, recovery_active 1",
        ),
        (
            lambda: SafetyMonitor(safe_set, n_q, n_v),
            f"{x} -> safe 1 < *, margins {len(safe_set.names)} < *",
        ),
        (
            lambda: AssessorInputs(
                k, safe_set, gravity=[0, 0, -9.81], servo_loads=True, memory=["m"], num_outlook=2
            ),
            f"{x}, desired_outlook 6, desired_joint_state {2 * n_j}, controller_memory 1 -> "
            f"state {12 + 2 * n_j} < plant_state, features {len(safe_set.feature_names) + n_j + 3} "
            f"< *, margins {len(safe_set.names)} < plant_state",
        ),
    ):
        CASES[f"{type(make()).__name__} {name}"] = make, text


for name in ROBOT_NAMES:
    add_robot(name)

ONE_OF_EACH = [key for key in CASES if key.split()[1:] in ([], ["laikago"])]


class Given(Bench):
    """A system with the ports that it promises, whose inputs are given."""

    def __init__(self, key, without=(), **values):
        make, text = CASES[key]
        inputs, outputs = (side.split(", ") for side in text.split(" -> "))
        pairs = [one.split() for one in inputs]
        # An abstract port, `-`, has the size 0.
        self.inputs = {name.strip("?"): int(size.replace("-", "0")) for name, size in pairs}
        self.optional = {name.strip("?") for name, _ in pairs if "?" in name}
        self.promised, self.through = {}, set()
        for output in outputs:
            name, size, *sources = output.replace(" < ", " ").split()
            self.promised[name] = size
            self.through |= {(one, name) for one in self.inputs if one in sources or "*" in sources}
        given = {port: self.value(key, port) for port in self.vectors - set(without)}
        super().__init__(make(), **given | values)

    @property
    def vectors(self):
        return {port for port, size in self.inputs.items() if size}

    def value(self, key, port):
        if port == "plant_state" and len(key.split()) > 1:
            kinematics = robot_kinematics(key.split()[1])
            v = np.zeros(kinematics.num_velocities)
            return np.append(kinematics.standing_positions(), v)
        return {
            "safe": [1.0],
            "recovery_active": [float("Planner" in key)],
            "desired_output": [0.0, 0.0, 0.4],
            "plant_state": np.eye(1, self.inputs[port]).ravel(),
        }.get(port, np.zeros(self.inputs[port]))

    def at(self, time_s):
        self.simulator.AdvanceTo(time_s)
        return self.outputs()


@pytest.mark.parametrize("key", CASES)
def test_ports_have_the_promised_names_and_sizes_and_feed_through_what_they_say(key):
    given = Given(key)
    system = given.system
    ins = [system.get_input_port(i) for i in range(system.num_input_ports())]
    outs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert {port.get_name(): port.size() for port in ins} == given.inputs
    abstract = [port for port in outs if port.get_data_type() == PortDataType.kAbstractValued]
    found = {port.get_name(): "-" if port in abstract else str(port.size()) for port in outs}
    assert found == given.promised
    is_direct = system.HasDirectFeedthrough
    pairs = [(one, other) for one in ins for other in outs]
    assert given.through == {
        (one.get_name(), other.get_name())
        for one, other in pairs
        if is_direct(one.get_index(), other.get_index())
    }


INNER = {
    ("RecoverySwitch", "nominal_desired_output"): "nominal",
    ("RecoverySwitch", "nominal_desired_preview"): "nominal",
    ("RecoverySwitch", "nominal_desired_outlook"): "nominal",
}


SYMBOLS = {
    "SensorFaults": {"n": 2},
    "TrajectoryPlanner": {"n_z": 3, "H": 7, "M": 5},
    "SafetyAssessor": {"n_s": 2, "n_z": 3, "H": 2, "n_f": 3, "n_c": 2},
    "CommandGuard": {"n_s": 1, "n_z": 3, "H": 4, "M": 3, "n_f": 3},
    "FeedbackRecorder": {
        "n_s": 1,
        "n_z": 3,
        "H": 3,
        "n_f": 1,
        "n_c": 2,
        "n_q": 1,
        "n_v": 1,
        "n": 4,
    },
    "PolicyController": {"n_q": 9, "n_v": 8, "n_j": 2, "n_m": 10, "n": 28},
    "AssessorInputs": {"M": 2, "n_m": 1},
}
LEARNED_SIZES = {"n_s": N_S, "n_w": N_S, "n_z": 3, "H": N_P // 3, "n_f": N_F, "n_c": N_C}
SYMBOLS |= {"ChangeMonitor": LEARNED_SIZES, "MonitoredSafetyAssessor": LEARNED_SIZES}


def symbols(key):
    """What the sizes in a docstring stand for, in a case."""
    name, *robot = key.split()
    found = {}
    if robot:
        k = robot_kinematics(*robot)
        found = {"n_q": k.num_positions, "n_v": k.num_velocities, "n_j": k.num_joints}
        found |= {"n_p": k.num_contacts, "n_s": 12 + 2 * k.num_joints, "n_z": 3, "H": 4, "M": 3}
        safe_set = BalanceSafeSet(k, BalanceLimits())
        more = 3 + k.num_joints if name == "AssessorInputs" else 0
        found |= {"n_c": len(safe_set.names), "n_f": len(safe_set.feature_names) + more}
    return found | SYMBOLS.get(name, {})


@pytest.mark.parametrize("key", [key for key in CASES if not key.startswith("Pendulum")])
def test_the_docstring_says_the_size_of_every_port_and_which_may_be_left_open(key):
    given = Given(key)
    block = system_block.parse_block(inspect.getdoc(type(given.system)))

    def size(port):
        product = re.sub(r"(?<=\w) (?=\w)", " * ", port.size)
        return None if product == "abstract" else eval(product, symbols(key))

    assert {one.name: size(one) or 0 for one in block.inputs} == given.inputs
    promised = {name: None if n == "-" else int(n) for name, n in given.promised.items()}
    assert {one.name: size(one) for one in block.outputs} == promised
    assert {one.name for one in block.inputs if one.remark == "optional"} == given.optional


@pytest.mark.parametrize("key", ONE_OF_EACH)
def test_optional_ports_may_be_left_open_and_any_other_is_named(key):
    given = Given(key, Given(key).optional)
    given.at(0.0)
    given.at(0.3)
    for port in given.inputs.keys() - given.optional:
        # Within a diagram it may be that of one of Drake's.
        name = INNER.get((key.split()[0], port), port)
        without = Given(key, {port})
        with pytest.raises(RuntimeError, match=rf"required InputPort.*\({name}.*is not connected"):
            without.at(0.0)
            without.at(0.3)


@pytest.mark.parametrize("key", ONE_OF_EACH)
def test_all_memory_is_in_the_context_so_a_clone_goes_on_as_if_alone(key):
    given, alone = Given(key), Given(key)
    for bench in (given, alone):
        bench.at(0.05)
    clone = Bench(given.system)
    clone.simulator.reset_context(given.context.Clone())
    clone.context = clone.simulator.get_mutable_context()
    given.fix(**{port: given.value(key, port) + np.full(1, 0.1) for port in given.vectors})
    given.at(0.3)
    for time_s in (0.06, 0.1, 0.3):
        for bench in (clone, alone):
            bench.simulator.AdvanceTo(time_s)
        expected = alone.outputs()
        for name, found in clone.outputs().items():
            if given.promised[name] != "-":
                np.testing.assert_array_equal(found, expected[name])


NOT_FINITE = {
    ("SafetyMonitor laikago", "plant_state"): {"safe": 0.0, "margins": -np.inf},
    ("StateObserver laikago", "plant_state"): {"state": np.nan},
    ("AssessorInputs laikago", "plant_state"): {"state": np.nan, "margins": -np.inf},
    ("SafetyAssessor", "state"): {"belief": [0.0, 0.0, 1.0], "safety_probability": 0.0},
    ("CommandGuard", "command"): {"desired_output": 0.0, "is_changed": 1.0},
}


@pytest.mark.parametrize(("key", "port"), NOT_FINITE)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_entry_that_is_not_finite_has_the_promised_answer(key, port, value):
    given = Given(key)
    before, promised = given.at(0.01), NOT_FINITE[key, port]
    assert any(np.any(before[name] != np.array(promised[name])) for name in promised)
    for entry in range(given.inputs[port]):
        values = np.array(given.value(key, port))
        values[entry] = value
        found = Given(key, **{port: values}).at(0.01)
        for name, expected in promised.items():
            np.testing.assert_array_equal(found[name], np.broadcast_to(expected, found[name].shape))


@pytest.mark.parametrize("norm", [0.0, 1e-160, 1e-12, np.nan])
@pytest.mark.parametrize("has_noise", [False, True])
@pytest.mark.parametrize("is_walking", [False, True])
def test_a_base_without_orientation_is_unknown_and_outside_the_safe_set(
    is_walking, has_noise, norm
):
    k = robot_kinematics("laikago")
    x = np.append(k.standing_positions(), np.zeros(k.num_velocities))
    x[:4] *= norm
    safe_set = WalkingSafeSet(k, WalkingLimits()) if is_walking else BalanceSafeSet(k, LIMITS)
    options = {"num_outlook": 2, "gravity": [0.0, 0.0, -9.81], "is_walking": is_walking}
    given = {"plant_state": x, "desired_outlook": np.zeros(6)}
    inputs = Bench(AssessorInputs(k, safe_set, **options), **given).outputs()
    monitor = SafetyMonitor(safe_set, k.num_positions, k.num_velocities)
    monitored = Bench(monitor, plant_state=x).outputs()
    noise = ObservationNoise(position=0.01, velocity=0.01) if has_noise else None
    observer = StateObserver(k, noise, is_walking=is_walking)
    given = {"plant_state": x} | ({"noise": np.ones(2 * k.num_velocities)} if has_noise else {})
    observed = Bench(observer, **given).outputs()
    for found in (inputs["state"], inputs["features"][:-2], observed["state"]):
        assert np.isnan(found).all()
    assert monitored["safe"] == 0.0
    for found in (inputs["margins"], monitored["margins"]):
        assert (found == -np.inf).all()
    # The position is as measured; a velocity in the heading frame needs an orientation.
    assert np.isnan(observed["output"]).all() if is_walking else observed["output"][2] > 0.3


@pytest.mark.parametrize(
    ("key", "port", "value", "tick_s"),
    [
        ("SafetyAssessor", "state", [0.5, 0.0], 0.01),
        ("CommandGuard", "command", [0.5, 0.0, 0.0], 0.1),
        ("PolicyController", "command", [0.2, 0.4, 0.0], 0.02),
        ("PendulumController", "plant_state", [0.02, 0.0], 0.01),
        ("InverseKinematicsController laikago", "desired_output", [0.0, 0.0, 0.38], 0.012),
        ("WholeBodyController laikago", "desired_output", [0.0, 0.0, 0.38], 0.012),
    ],
)
def test_outputs_are_held_until_the_next_tick(key, port, value, tick_s):
    given, same = Given(key), Given(key)
    held = given.at(0.0025)
    given.fix(**{port: value})
    for name, later in given.at(tick_s - 1e-4).items():
        np.testing.assert_array_equal(later, held[name])
    changed, expected = given.at(tick_s + 1e-4), same.at(tick_s + 1e-4)
    assert any(not np.array_equal(changed[name], expected[name]) for name in held)


def test_a_masked_margin_or_feature_is_not_a_number():
    class Masked(BalanceSafeSet):
        def margins(self, q, v):
            return np.ma.masked_less(super().margins(q, v), 10.0)

        def features(self, q, v, preview):
            return np.ma.masked_less(super().features(q, v, preview), 100.0)

    k = robot_kinematics("laikago")
    x = np.append(k.standing_positions(), np.zeros(k.num_velocities))
    safe_set = Masked(k, LIMITS)
    monitored = Bench(SafetyMonitor(safe_set, 19, 18), plant_state=x).outputs()
    assert np.isnan(monitored["margins"]).all() and monitored["safe"] == 0.0
    inputs = AssessorInputs(k, safe_set, num_outlook=2)
    given = {"plant_state": x, "desired_outlook": np.zeros(6)}
    assert np.isnan(Bench(inputs, **given).get("features")).all()
