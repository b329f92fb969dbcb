"""Laws of every system: its docstring's ports, open ports, feedthrough, clones, and NaN."""

import inspect
import re

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import PortDataType
from pydrake.trajectories import PiecewisePolynomial

import system_block
from drake_safety import load_assessment
from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.control.safe_sets import BalanceLimits, BalanceSafeSet
from drake_safety.diagrams.walking.safe_set import WalkingLimits, WalkingSafeSet
from drake_safety.models import load_robot
from drake_safety.robots.robot import ObservationNoise, add_robot
from drake_safety.robots.shift import Fault
from drake_safety.systems.assessor_inputs import AssessorInputs
from drake_safety.systems.change_monitor import ChangeMonitor
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor
from drake_safety.systems.motor_curves import MotorCurves
from drake_safety.systems.recovery_step_planner import RecoveryStepPlanner
from drake_safety.systems.recovery_switch import RecoverySwitch
from drake_safety.systems.recovery_trigger import RecoveryTrigger
from drake_safety.systems.safety_assessor import SafetyAssessor
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.sensor_faults import SensorFaults
from drake_safety.systems.state_observer import StateObserver
from drake_safety.systems.trajectory_planner import TrajectoryPlanner
from drake_safety.systems.whole_body_controller import WholeBodyController
from legged_robots import robot_kinematics
from system_doubles import INFO, AssessmentDouble, Bench, SlowIsSafe, controller, guard

ROBOT, BIPED = robot_kinematics("laikago"), robot_kinematics("biped")  # Of the same sizes.
STANDING = np.append(ROBOT.standing_positions(), np.zeros(18))
SAFE_SET = BalanceSafeSet(ROBOT, BalanceLimits())
STEPS = RecoveryStepParameters(min_steps=1, max_steps=1)
LEARNED = load_assessment("laikago_balancing")
PERIOD = {"period_s": 0.01}
LATE = PERIOD | {"offset_s": 0.002}
ROWS = PERIOD | {"horizon": 4, "num_outlook": 3}
PLAN = PiecewisePolynomial(np.zeros((3, 1)))
LAIKAGO = {"n_q": 19, "n_v": 18, "n_j": 12, "n_p": 4, "n_s": 36, "n_z": 3, "H": 4, "M": 3}
LAIKAGO |= {"n_c": 3, "n_f": len(SAFE_SET.feature_names)}
SIZES = {
    "n_s": 36,
    "n_w": 36,
    "n_u": len(LEARNED.detector_.columns),
    "n_z": 3,
    "H": LEARNED.info_.horizon,
    "n_c": 3,
}
SIZES["n_f"] = len(LEARNED.info_.feature_names)
DOUBLE = {"n_s": 2, "n_z": 3, "H": 2, "n_f": 3, "n_c": 2}
RECORDED = {"n_s": 1, "n_z": 3, "H": 3, "n_f": 1, "n_c": 2, "n_q": 1, "n_v": 1, "n": 4}


def motor_curves():
    plant = MultibodyPlant(0.001)
    instance = add_robot(plant, load_robot("laikago"))
    plant.Finalize()
    return MotorCurves(plant, instance, ["FR_hip_joint", "FR_calf_joint"])


# What makes a system, the symbols in its docstring, and its direct feedthrough.
CASES = {
    SensorFaults: (
        lambda: SensorFaults(["a", "b"], [Fault(kind="delay", value=0.2)], **PERIOD),
        {"n": 2},
        ["input output"],
    ),
    MotorCurves: (
        motor_curves,
        {"n_j": 2},
        [f"{port} desired_joint_state" for port in ("desired_joint_state", "joint_state")],
    ),
    RecoveryTrigger: (lambda: RecoveryTrigger(**PERIOD), {}, []),
    TrajectoryPlanner: (
        lambda: TrajectoryPlanner(horizon=7, step_s=0.1, plan=PLAN),
        {"n_z": 3, "H": 7, "M": 5},
        ["stance_pose desired_output", "stance_pose desired_output_rate"],
    ),
    SafetyAssessor: (
        lambda: SafetyAssessor(AssessmentDouble(), **PERIOD),
        DOUBLE,
        ["alarm learned"],
    ),
    ChangeMonitor: (lambda: ChangeMonitor(LEARNED), SIZES, []),
    MonitoredSafetyAssessor: (lambda: MonitoredSafetyAssessor(LEARNED), SIZES, []),
    type(guard(SlowIsSafe())): (
        lambda: guard(SlowIsSafe()),
        {"n_s": 1, "n_z": 3, "H": 4, "M": 3, "n_f": 3},
        [],
    ),
    FeedbackRecorder: (
        lambda: FeedbackRecorder(
            INFO, num_steps=5, plant_state_size=2, watch_period_s=0.01, controller_memory_size=4
        ),
        RECORDED,
        ["* num_finished"],
    ),
    type(controller()): (controller, {"n_q": 9, "n_v": 8, "n_j": 2, "n_m": 10, "n": 28}, []),
    StateObserver: (
        lambda: StateObserver(ROBOT),
        LAIKAGO,
        ["* measured_plant_state", "* state", "* output"],
    ),
    InverseKinematicsController: (lambda: InverseKinematicsController(ROBOT, **LATE), LAIKAGO, []),
    WholeBodyController: (lambda: WholeBodyController(BIPED, hand="head", **LATE), LAIKAGO, []),
    RecoveryStepPlanner: (lambda: RecoveryStepPlanner(ROBOT, STEPS, **ROWS), LAIKAGO, []),
    RecoverySwitch: (
        lambda: RecoverySwitch(ROBOT, STEPS, threshold=0.6, offset_s=0.0005, **ROWS),
        LAIKAGO,
        [f"nominal_{port} {port}" for port in ("desired_output", "desired_preview")]
        + ["nominal_desired_outlook desired_outlook"],
    ),
    SafetyMonitor: (lambda: SafetyMonitor(SAFE_SET, 19, 18), LAIKAGO, ["* safe", "* margins"]),
    AssessorInputs: (
        lambda: AssessorInputs(
            ROBOT, SAFE_SET, gravity=[0, 0, -9.81], servo_loads=True, memory=["m"], num_outlook=3
        ),
        LAIKAGO | {"n_f": LAIKAGO["n_f"] + 15, "n_m": 1},
        ["plant_state state", "* features", "plant_state margins"],
    ),
}
parametrize = pytest.mark.parametrize("kind", CASES, ids=lambda kind: kind.__name__)


class Given(Bench):
    """A system with the ports of its docstring, whose vector inputs are given."""

    def __init__(self, kind, without=(), **values):
        make, symbols, self.through = CASES[kind]
        block = system_block.parse_block(inspect.getdoc(kind))

        def sizes(ports):
            products = {one.name: re.sub(r"(?<=\w) (?=\w)", " * ", one.size) for one in ports}
            known = symbols | {"abstract": 0}
            return {name: eval(product, known.copy()) for name, product in products.items()}

        self.inputs, self.promised = sizes(block.inputs), sizes(block.outputs)
        self.optional = {one.name for one in block.inputs if one.remark == "optional"}
        self.vectors = {port for port, size in self.inputs.items() if size} - set(without)
        super().__init__(make(), **{port: self.value(kind, port) for port in self.vectors} | values)

    def value(self, kind, port):
        size = self.inputs[port]
        if kind is WholeBodyController and port == "plant_state":
            return np.append(BIPED.standing_positions(), np.zeros(18))
        known = {
            "safe": [1.0],
            "recovery_active": [float(kind is RecoveryStepPlanner)],
            "desired_output": [0.0, 0.0, 0.4],
            "plant_state": STANDING if size == 37 else np.eye(1, size).ravel(),
        }
        return np.array(known.get(port, np.zeros(size)))

    def at(self, time_s):
        self.simulator.AdvanceTo(time_s)
        return self.outputs()


@parametrize
def test_ports_are_those_of_the_docstring_and_feed_through_what_is_stated(kind):
    given = Given(kind)
    system = given.system
    ins = [system.get_input_port(i) for i in range(system.num_input_ports())]
    outs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert {port.get_name(): port.size() for port in ins} == given.inputs
    is_vector = PortDataType.kVectorValued
    sizes = {p.get_name(): p.size() if p.get_data_type() == is_vector else 0 for p in outs}
    assert sizes == given.promised
    stated = [pair.split() for pair in given.through]
    assert {(a, b) for source, b in stated for a in given.inputs if source in (a, "*")} == {
        (one.get_name(), other.get_name())
        for one in ins
        for other in outs
        if system.HasDirectFeedthrough(one.get_index(), other.get_index())
    }


@parametrize
def test_optional_ports_may_be_left_open_and_any_other_is_named(kind):
    given = Given(kind, Given(kind).optional)
    given.at(0.0)
    given.at(0.3)
    for port in given.inputs.keys() - given.optional:
        # Within a diagram it may be that of one of Drake's.
        name = "nominal" if kind is RecoverySwitch and port.startswith("nominal") else port
        without = Given(kind, {port})
        with pytest.raises(RuntimeError, match=rf"required InputPort.*\({name}.*is not connected"):
            without.at(0.0)
            without.at(0.3)


@parametrize
def test_all_memory_is_in_the_context_so_a_clone_goes_on_as_if_alone(kind):
    given, alone = Given(kind), Given(kind)
    for bench in (given, alone):
        bench.at(0.05)
    clone = Bench(given.system)
    clone.simulator.reset_context(given.context.Clone())
    clone.context = clone.simulator.get_mutable_context()
    given.fix(**{port: given.value(kind, port) + 0.1 for port in given.vectors})
    given.at(0.3)
    for time_s in (0.06, 0.1, 0.3):
        for bench in (clone, alone):
            bench.simulator.AdvanceTo(time_s)
        expected = alone.outputs()
        for name, value in clone.outputs().items():
            if given.promised[name]:
                np.testing.assert_array_equal(value, expected[name])


NOT_FINITE = [
    (SafetyMonitor, "plant_state", {"safe": 0.0, "margins": -np.inf}),
    (StateObserver, "plant_state", {"state": np.nan}),
    (AssessorInputs, "plant_state", {"state": np.nan, "margins": -np.inf}),
    (SafetyAssessor, "state", {"belief": [0.0, 0.0, 1.0], "safety_probability": 0.0}),
    (type(guard(SlowIsSafe())), "command", {"desired_output": 0.0, "is_changed": 1.0}),
]


@pytest.mark.parametrize(("kind", "port", "promised"), NOT_FINITE)
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_an_entry_that_is_not_finite_has_the_promised_answer(kind, port, promised, value):
    given = Given(kind)
    before = given.at(0.01)
    assert any(np.any(before[name] != np.array(promised[name])) for name in promised)
    for entry in range(given.inputs[port]):
        values = given.value(kind, port)
        values[entry] = value
        outputs = Given(kind, **{port: values}).at(0.01)
        for name, expected in promised.items():
            expected = np.broadcast_to(expected, outputs[name].shape)
            np.testing.assert_array_equal(outputs[name], expected)


@pytest.mark.parametrize("norm", [0.0, 1e-160, np.nan])
@pytest.mark.parametrize("has_noise", [False, True])
@pytest.mark.parametrize("is_walking", [False, True])
def test_a_base_without_orientation_is_unknown_and_outside_the_safe_set(
    is_walking, has_noise, norm
):
    x = STANDING.copy()
    x[:4] *= norm
    safe_set = WalkingSafeSet(ROBOT, WalkingLimits()) if is_walking else SAFE_SET
    options = {"num_outlook": 2, "gravity": [0.0, 0.0, -9.81], "is_walking": is_walking}
    given = {"plant_state": x, "desired_outlook": np.zeros(6)}
    inputs = Bench(AssessorInputs(ROBOT, safe_set, **options), **given).outputs()
    monitored = Bench(SafetyMonitor(safe_set, 19, 18), plant_state=x).outputs()
    noise = ObservationNoise(position=0.01, velocity=0.01) if has_noise else None
    given = {"plant_state": x} | ({"noise": np.ones(36)} if has_noise else {})
    observed = Bench(StateObserver(ROBOT, noise, is_walking=is_walking), **given).outputs()
    for values in (inputs["state"], inputs["features"][:-2], observed["state"]):
        assert np.isnan(values).all()
    assert monitored["safe"] == 0.0
    for values in (inputs["margins"], monitored["margins"]):
        assert (values == -np.inf).all()
    # The position is as measured; a velocity in the heading frame needs an orientation.
    assert np.isnan(observed["output"]).all() if is_walking else observed["output"][2] > 0.3


@pytest.mark.parametrize(
    ("kind", "port", "value", "tick_s"),
    [
        (SafetyAssessor, "state", [0.5, 0.0], 0.01),
        (type(guard(SlowIsSafe())), "command", [0.5, 0.0, 0.0], 0.1),
        (type(controller()), "command", [0.2, 0.4, 0.0], 0.02),
        (InverseKinematicsController, "desired_output", [0.0, 0.0, 0.38], 0.012),
        (WholeBodyController, "desired_output", [0.0, 0.0, 0.38], 0.012),
    ],
)
def test_outputs_are_held_until_the_next_tick(kind, port, value, tick_s):
    given, same = Given(kind), Given(kind)
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

    safe_set = Masked(ROBOT, BalanceLimits())
    monitored = Bench(SafetyMonitor(safe_set, 19, 18), plant_state=STANDING).outputs()
    assert np.isnan(monitored["margins"]).all() and monitored["safe"] == 0.0
    given = {"plant_state": STANDING, "desired_outlook": np.zeros(6)}
    inputs = AssessorInputs(ROBOT, safe_set, num_outlook=2)
    assert np.isnan(Bench(inputs, **given).get("features")).all()
