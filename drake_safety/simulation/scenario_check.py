"""A scenario, looked over before rollouts are wasted on it: what is missing, and how to mend it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydrake.geometry import Sphere
from pydrake.systems.analysis import Simulator

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon
from drake_safety.models import load_robot, robot_files
from drake_safety.robots.robot_model import RobotModel, by_pattern
from drake_safety.simulation.capabilities import HasBall
from drake_safety.simulation.contract import Finding, check_contract
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import run_episode
from drake_safety.simulation.scenario import Scenario, load_scenario

_Value = TypeVar("_Value")

_LEVEL_M = 2e-3  # How unequal the feet's heights may be.
_SINK_SHARE = 0.1  # Of the standing height, that a robot may sink while it stands.
_MATCH_M = 1e-3
_UNSAFE_SHARES = (0.1, 0.9)


@dataclass
class _State:
    """What one check finds and a later one needs."""

    scenario: Scenario | None = None
    robot: RobotModel | None = None
    kinematics: RobotKinematics | None = None
    loop: Any = None  # A ClosedLoop; one of a robot is a LeggedLoop.


def check_scenario(name: str | Path, *, num_episodes: int = 16, seed: int = 0) -> Iterator[Finding]:
    """Looks a scenario over, item by item, the cheap ones first.

    What a user's files do wrong is a finding, never an exception. Once the scenario, the robot or
    the diagram cannot be made, what depends on it is left out.

    Args:
        name: Of a scenario that comes with the package, or the path of one.
        num_episodes: Episodes that are simulated for the share of unsafe ones; 0 for none.
        seed: Their seed.

    Yields:
        The findings, as they are found.
    """
    state = _State()
    yield from _guarded("scenario", lambda: _scenario(state, name))
    if state.scenario is None:
        return
    if state.scenario.robot:
        yield from _guarded("robot.yaml", lambda: _robot(state))
        if state.robot is None:
            return
        yield from _guarded("bodies and joints", lambda: _kinematics(state))
        if state.kinematics is None:
            return
        yield from _guarded("standing posture", lambda: _posture(state))
        yield from _guarded("motors", lambda: _motors(state))
    yield from _guarded("diagram", lambda: _diagram(state))
    if state.loop is None:
        return
    if isinstance(state.loop, LeggedLoop):
        yield from _guarded("contact spheres", lambda: _contacts(state))
        yield from _guarded("shape of the base", lambda: _target(state))
        yield from _guarded("stands for 1 s", lambda: _stands(state))
    loop = state.loop
    yield from _guarded("contract", lambda: iter(check_contract(loop, seed=seed)))
    if num_episodes:
        yield from _guarded("episodes", lambda: _episodes(state, num_episodes, seed))


def _guarded(item: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from check()
    # A task of one's own may raise anything, and so may Drake's parser.
    except Exception as error:
        yield Finding(
            item=item,
            is_ok=False,
            message=f"{error}" if isinstance(error, ValueError) else f"{_kind(error)}: {error}",
            remedy="mend what the message names",
        )


def _kind(error: Exception) -> str:
    return type(error).__name__


def _ok(item: str, message: str) -> Finding:
    return Finding(item=item, is_ok=True, message=message)


def _bad(item: str, message: str, remedy: str) -> Finding:
    return Finding(item=item, is_ok=False, message=message, remedy=remedy)


def _scenario(state: _State, name: str | Path) -> Iterator[Finding]:
    scenario = load_scenario(name)
    task = scenario.task_class()
    yield _ok("scenario", f"'{scenario.name}' fits the schema of {task.__name__}")
    state.scenario = scenario
    if "nominal" not in scenario.variations:
        yield _bad(
            "plants",
            f"no variation 'nominal'; it has {list(scenario.variations)}",
            "add `nominal: {}` under 'variations': it is what Γ learns from",
        )
        state.scenario = None
    elif "actual" not in scenario.variations:
        yield _bad(
            "plants",
            "no variation 'actual', which `run` and throws simulate",
            "add `actual: {}` under 'variations', with how the real robot differs",
        )
    else:
        yield _ok("plants", ", ".join(scenario.variations))


def _robot(state: _State) -> Iterator[Finding]:
    scenario = _of(state.scenario)
    robot = load_robot(scenario.robot)
    yield _ok("robot.yaml", f"'{robot.name}' fits the schema")
    missing = [str(path) for path in robot_files(scenario.robot) if not path.is_file()]
    if missing:
        yield _bad("files", f"not found: {missing}", "set 'urdf' to a path beside robot.yaml")
        return
    yield _ok("files", "found")
    state.robot = robot


def _kinematics(state: _State) -> Iterator[Finding]:
    kinematics = RobotKinematics(_of(state.robot))
    state.kinematics = kinematics
    yield _ok(
        "bodies and joints",
        f"{len(kinematics.foot_names)} feet, {kinematics.num_joints} joints, "
        f"{kinematics.total_mass:.1f} kg",
    )


def _posture(state: _State) -> Iterator[Finding]:
    kinematics = _of(state.kinematics)
    q = kinematics.standing_positions()
    low, high = kinematics.position_limits.T
    beyond = (kinematics.posture < low) | (kinematics.posture > high)
    if beyond.any():
        names = [name for name, wrong in zip(kinematics.joint_names, beyond, strict=True) if wrong]
        yield _bad("joint stops", f"the posture is beyond those of {names}", "change 'posture'")
    p_WC = kinematics.contact_positions(q)
    heights = p_WC[:, 2] - kinematics.foot_radii
    if np.ptp(heights) > _LEVEL_M:
        high_feet = [
            name
            for name, points in zip(kinematics.foot_names, kinematics.foot_slices, strict=True)
            if heights[points].max() > _LEVEL_M
        ]
        yield _bad(
            "feet level",
            f"feet {high_feet} hang up to {100 * np.ptp(heights):.1f} cm over the ground",
            "change 'posture' until all feet are equally low, or their contact points",
        )
    else:
        yield _ok(
            "feet level",
            f"within {1000 * np.ptp(heights):.1f} mm, base {kinematics.standing_height:.3f} m high",
        )
    corners = convex_hull(p_WC[:, :2])
    for item, point in (
        ("centre of mass over the feet", kinematics.center_of_mass(q)),
        ("base over the feet", q[4:7]),
    ):
        distance = signed_distance_to_polygon(point[:2], corners)
        if distance > 0:
            yield _ok(item, f"{100 * distance:.1f} cm inside their polygon")
        else:
            yield _bad(
                item,
                f"{-100 * distance:.1f} cm outside their polygon",
                "change 'posture' so that the feet surround it, or 'contact_points'",
            )


def _diagram(state: _State) -> Iterator[Finding]:
    state.loop = _of(state.scenario).make_loop()
    yield _ok("diagram", f"{type(state.loop).__name__} is built")


def _motors(state: _State) -> Iterator[Finding]:
    kinematics, robot = _of(state.kinematics), _of(state.robot)
    plant = kinematics.plant
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    limits = {actuator.joint().name(): actuator.effort_limit() for actuator in actuators}
    without = [name for name in kinematics.joint_names if name not in limits]
    if without:
        yield _bad(
            "motors",
            f"joints {without} have none",
            "give them an effort limit [N·m] under 'effort_limits' in robot.yaml",
        )
    else:
        yield _ok("motors", f"one on each of {len(limits)} joints")
    unlimited = [name for name, limit in limits.items() if not np.isfinite(limit)]
    if unlimited:
        yield _bad(
            "effort limits",
            f"the motors of joints {unlimited} have none, so that no load is too heavy",
            "give them one [N·m] under 'effort_limits' in robot.yaml",
        )
    if robot.joint_gains:
        loose = [
            name
            for name in kinematics.joint_names
            if by_pattern(robot.joint_gains, name, "gains", robot.name) is None
        ]
        if loose:
            yield _bad(
                "servo gains", f"joints {loose} have none", "add them under 'joint_gains' [N·m/rad]"
            )
    q = kinematics.standing_positions()
    torques = kinematics.gravity_torques(q, np.ones(kinematics.num_contacts, dtype=bool))
    weak = [
        f"{name} needs {abs(torque):.1f} of {limits[name]:.1f} N·m"
        for name, torque in zip(kinematics.joint_names, torques, strict=True)
        if name in limits and abs(torque) > limits[name]
    ]
    if weak:
        yield _bad(
            "effort against gravity",
            "; ".join(weak),
            "check the effort limits' unit [N·m], the masses [kg], or straighten the legs",
        )
    else:
        shares = [
            abs(torque) / limits[name]
            for name, torque in zip(kinematics.joint_names, torques, strict=True)
            if name in limits
        ]
        yield _ok("effort against gravity", f"{100 * max(shares, default=0):.0f} % at most")


def _target(state: _State) -> Iterator[Finding]:
    """Whether a ball can hit the base, of a task that throws some."""
    loop, robot = _of(state.loop), _of(state.robot)
    if not isinstance(state.loop, HasBall):
        return
    plant = loop.plant
    base = plant.GetBodyByName(robot.base, loop.robot_instance)
    bodies = plant.GetBodiesWeldedTo(base)
    count = sum(len(plant.GetCollisionGeometriesForBody(body)) for body in bodies)
    if count:
        yield _ok("shape of the base", f"{count} collision shapes for balls to hit")
    else:
        yield _bad(
            "shape of the base",
            f"base '{robot.base}' has no collision geometry, so balls, also those that episodes "
            "begin with, fly through it",
            f"add a <collision> with a box as large as the trunk [m] to link '{robot.base}' in "
            f"{Path(robot.urdf).name}; with 'collision: stated', name it under 'shapes' in "
            "robot.yaml",
        )


def _contacts(state: _State) -> Iterator[Finding]:
    loop, kinematics, robot = _of(state.loop), _of(state.kinematics), _of(state.robot)
    plant = loop.plant
    inspector = loop.GetSubsystemByName("scene_graph").model_inspector()
    missing = []
    for name, foot in robot.feet.items():
        body = plant.GetBodyByName(foot.body, loop.robot_instance)
        spheres = [
            (inspector.GetPoseInFrame(g).translation(), inspector.GetShape(g).radius())
            for g in plant.GetCollisionGeometriesForBody(body)
            if isinstance(inspector.GetShape(g), Sphere)
        ]
        for point in foot.contact_points:
            if not any(
                np.linalg.norm(centre - point) < _MATCH_M and abs(r - foot.radius_m) < _MATCH_M
                for centre, r in spheres
            ):
                found = [f"{np.round(c, 4).tolist()} r {r:.4f}" for c, r in spheres]
                missing.append(f"{name} at {point} r {foot.radius_m}; it has {found or 'none'}")
    if missing:
        yield _bad(
            "contact spheres",
            "the model file has no such sphere: " + "; ".join(missing),
            "add a collision sphere to the URDF, or correct contact_points and radius_m [m]",
        )
    else:
        yield _ok("contact spheres", f"{kinematics.num_contacts} in the model file")


def _stands(state: _State) -> Iterator[Finding]:
    loop, kinematics = _of(state.loop), _of(state.kinematics)
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    start = loop.standing_start()
    loop.reset_to(context, None, start)
    simulator.Initialize()
    margins = loop.GetOutputPort("margins")
    found = margins.Eval(context)
    names = loop.constraint_names
    if found.min() < 0:
        wrong = [name for name, margin in zip(names, found, strict=True) if margin < 0]
        yield _bad(
            "safe while it stands",
            f"the standing posture violates {wrong}",
            "scale 'safe_set' to the robot: its heights [m] must include the standing height "
            f"{kinematics.standing_height:.3f}",
        )
    else:
        yield _ok("safe while it stands", "the posture is in the safe set")
    simulator.AdvanceTo(1.0)
    state_now = loop.GetOutputPort("plant_state").Eval(context)
    q, v = np.split(state_now, [kinematics.num_positions])
    sunk = kinematics.standing_height - q[6]
    speed = float(np.abs(v[NUM_BASE_VELOCITIES:]).max(initial=0.0))
    clearance = kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii
    touching = int(np.sum(clearance < 5e-3))
    message = (
        f"after 1 s it has sunk {100 * sunk:.1f} cm, {touching} of {kinematics.num_contacts} "
        f"contact points touch, the fastest joint turns at {speed:.2f} rad/s"
    )
    if abs(sunk) > _SINK_SHARE * kinematics.standing_height or speed > 1.0 or not touching:
        yield _bad(
            "stands for 1 s",
            message,
            "raise 'joint_gains' [N·m/rad] if it sinks, lower them if it trembles; look for shapes "
            "that overlap",
        )
    else:
        yield _ok("stands for 1 s", message)


def _episodes(state: _State, num_episodes: int, seed: int) -> Iterator[Finding]:
    loop = _of(state.loop)
    episodes = [run_episode(loop, index, seed=seed) for index in range(num_episodes)]
    causes: dict[str, int] = {}
    for episode in episodes:
        if not episode.is_safe:
            causes[episode.cause] = causes.get(episode.cause, 0) + 1
    yield _ok("starts can be sampled", f"{num_episodes} episodes simulated")
    lost = sum(episode.num_steps == 0 for episode in episodes)
    if lost > num_episodes / 4:
        yield _bad(
            "starts are safe",
            f"{lost} of {num_episodes} episodes begin outside the safe set",
            "narrow the ranges under 'start', or widen 'safe_set'",
        )
    if causes.pop("diverged", 0):
        yield _bad(
            "simulation", "an episode diverged", "lower time_step_s [s], or the gains; see masses"
        )
    share = sum(causes.values()) / num_episodes
    message = f"{100 * share:.0f} % of {num_episodes} episodes: " + (
        ", ".join(f"{name} {count}" for name, count in causes.items()) or "none"
    )
    low, high = _UNSAFE_SHARES
    if low <= share <= high:
        yield _ok("share of unsafe episodes", message)
    else:
        yield _bad(
            "share of unsafe episodes",
            message,
            "widen the ranges of start and plan, or narrow 'safe_set': Γ learns from both kinds"
            if share < low
            else "narrow the ranges of start and plan, or widen 'safe_set': Γ learns from both",
        )


def _of(value: _Value | None) -> _Value:
    """What an earlier check has set."""
    if value is None:
        raise ValueError("an earlier item has failed")
    return value
