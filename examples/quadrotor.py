"""From an empty file to Γ in a diagram of pydrake's own parts: a quadrotor and its LQR."""

import numpy as np
from pydrake.examples import QuadrotorPlant, StabilizingLQRController
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem

from drake_safety import AddSafetyAssessor, AssessmentParameters, SafetyAssessment, record_episodes

HORIZON, STEP_S, GOAL = 10, 0.1, np.array([0.0, 0.0, 1.0])
START = np.array([1, 1, 0.7, 1.1, 1.1, 1, 4, 4, 4, 8, 8, 1])  # As far as it may begin.


class Flight(LeafSystem):  # Where it is, where it shall hover, how far from floor and tipping.
    def __init__(self):
        super().__init__()
        x = self.DeclareVectorInputPort("state", 12)
        for name, size, calc in (
            ("output", 3, lambda c: x.Eval(c)[:3]),
            ("desired_preview", 3 * HORIZON, lambda c: np.tile(GOAL, HORIZON)),
            ("margins", 2, lambda c: [x.Eval(c)[2] - 0.1, 1.2 - abs(x.Eval(c)[3:5]).max()]),
        ):
            calc = lambda c, value, calc=calc: value.SetFromVector(calc(c))  # noqa: E731
            self.DeclareVectorOutputPort(name, BasicVector(size), calc)


def make_diagram(assessment=None):
    builder = DiagramBuilder()
    quadrotor = builder.AddNamedSystem("quadrotor", QuadrotorPlant())
    state = quadrotor.get_output_port()
    flight = builder.AddSystem(Flight())
    controller = builder.AddSystem(StabilizingLQRController(quadrotor, GOAL))
    builder.Connect(state, controller.get_input_port())
    builder.Connect(controller.get_output_port(), quadrotor.get_input_port())
    builder.Connect(state, flight.get_input_port())
    builder.ExportOutput(state, "state")
    for name in ("output", "desired_preview", "margins"):
        builder.ExportOutput(flight.GetOutputPort(name), name)
    if assessment is not None:
        ports = {name: flight.GetOutputPort(name) for name in ("desired_preview", "margins")}
        assessor = AddSafetyAssessor(builder, assessment, state=state, **ports)
        builder.ExportOutput(assessor.GetOutputPort("safety_probability"), "gamma")
    return builder.Build()


def reset(diagram, context, rng):
    quadrotor = diagram.GetSubsystemByName("quadrotor")
    start = np.append(GOAL, np.zeros(9)) + START * rng.uniform(-1, 1, 12)
    quadrotor.GetMyMutableContextFromRoot(context).SetContinuousState(start)


def fly(num_episodes, **options):
    options |= {"duration_s": 2.0, "step_s": STEP_S, "constraint_names": ["height", "tilt"]}
    return record_episodes(make_diagram, num_episodes, reset=reset, **options)


def learn(num_episodes=1000, *, num_workers=None, **parameters):
    episodes = fly(num_episodes, num_workers=num_workers)
    return SafetyAssessment(AssessmentParameters(horizon=HORIZON, **parameters)).fit(episodes)


def main(num_episodes=1000, **options):
    assessment = learn(num_episodes, **options)
    fresh = fly(num_episodes // 4, seed=1, num_workers=options.get("num_workers"))
    starts = [(one.state[0], one.desired_preview[0]) for one in fresh]
    gamma = np.array([assessment.predict_one(*start).probability for start in starts])
    is_safe = np.array([one.is_safe for one in fresh])
    print(f"{assessment}; of {len(fresh)} fresh flights {is_safe.sum()} stay safe.")
    for what, rows in ("stay safe", is_safe), ("do not", ~is_safe):
        print(f"Γ before those that {what}: {gamma[rows].mean():.2f} in the mean")


if __name__ == "__main__":
    main()
