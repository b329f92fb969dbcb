"""Check of a scenario before rollouts: what is wrong, and how to correct it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import Sphere
from pydrake.systems.analysis import Simulator

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon
from drake_safety.files.progress import StageProgress
from drake_safety.learning.segments import DIVERGED
from drake_safety.models import load_robot, robot_files
from drake_safety.robots.robot_model import RobotModel, by_pattern
from drake_safety.robots.urdf_copy import read_urdf
from drake_safety.simulation.capabilities import HasBall
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.contract import Finding, check_contract, failed, passed, warned
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.remedies import (
    LEVEL_M,
    effort_limits,
    feet_below,
    level_feet,
    scaled_gains,
    scaled_start,
    within_stops,
)
from drake_safety.simulation.rollouts import run_episode
from drake_safety.simulation.scenario import Scenario, load_scenario, read_scenario

_STANDS = "stands for 1 s"
_SINK_SHARE = 0.1  # Share of the standing height by which a robot may sink.
_MATCH_M = 1e-3
_UNSAFE_SHARES = (0.1, 0.9)


@dataclass
class _State:
    """Results of checks that later ones need."""

    scenario: Scenario | None = None
    robot: RobotModel | None = None
    kinematics: RobotKinematics | None = None
    loop: ClosedLoop | None = None


def check_scenario(
    name: str | Path,
    *,
    num_episodes: int = 16,
    seed: int = 0,
    is_imported: bool = True,
    progress: StageProgress | None = None,
) -> Iterator[Finding]:
    """Checks a scenario item by item, the cheap ones first.

    An error in a user's files is a finding, never an exception. Checks that depend on a scenario,
    robot or diagram that cannot be made are left out.

    Args:
        name: Name of a scenario of the package, or the path of one.
        num_episodes: Number of episodes simulated to estimate the share of unsafe ones.
        seed: Seed of the episodes.
        is_imported: Whether the scenario's task is imported, which runs its code. If not, only the
            files are checked.
        progress: Called with a stage, the number done and the number wanted.

    Yields:
        The findings.
    """
    state = _State()
    report: StageProgress = progress or (lambda stage, done, total: None)
    if is_imported:
        yield from _guarded("scenario", lambda: _scenario(state, name))
    else:
        yield from _guarded("scenario", lambda: _unimported_scenario(state, name))
    if (scenario := state.scenario) is None:
        return
    if scenario.robot:
        yield from _guarded("robot.yaml", lambda: _robot(state, scenario))
        if (robot := state.robot) is None:
            return
        yield from _guarded("bodies and joints", lambda: _kinematics(state, robot))
        if (kinematics := state.kinematics) is None:
            return
        yield from _guarded("standing posture", lambda: _posture(kinematics))
        yield from _guarded("motors", lambda: _motors(kinematics))
        yield from _guarded("collision shapes", lambda: _collisions(robot))
    if not is_imported:
        return
    own = list(_guarded("files of the task", lambda: _own(state, scenario)))
    yield from own
    if not all(finding.is_ok for finding in own):
        return
    yield from _guarded("diagram", lambda: _diagram(state, scenario))
    if (loop := state.loop) is None:
        return
    if isinstance(loop, LeggedLoop):
        yield from _guarded("contact spheres", lambda: _contacts(loop))
        yield from _guarded("shape of the base", lambda: _target(loop))
        report(_STANDS, 0, 1)
        yield from _guarded(_STANDS, lambda: _stands(loop))
        report(_STANDS, 1, 1)
    yield from _guarded("contract", lambda: iter(check_contract(loop, seed=seed)))
    if num_episodes:
        yield from _guarded("episodes", lambda: _episodes(loop, num_episodes, seed, report))


def _guarded(item: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from check()
    # A user's task may raise anything, and so may Drake's parser.
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        yield failed(item, f"{kind}{error}", "correct what the message names")


def _scenario(state: _State, name: str | Path) -> Iterator[Finding]:
    scenario = load_scenario(name)
    task = scenario.task_class()
    yield passed("scenario", f"'{scenario.name}' fits the schema of {task.__name__}")
    file = getattr(sys.modules[task.__module__], "__file__", None)
    yield passed("code", f"the scenario runs {scenario.task}, {file}")
    yield from _plants(state, scenario)


def _unimported_scenario(state: _State, name: str | Path) -> Iterator[Finding]:
    scenario, _ = read_scenario(name)
    yield passed("scenario", f"'{scenario.name}' fits the schema, but for its parameters")
    yield passed(
        "code", f"the scenario runs {scenario.task}, which was not imported; read it before you do"
    )
    yield from _plants(state, scenario)


def _plants(state: _State, scenario: Scenario) -> Iterator[Finding]:
    state.scenario = scenario
    if "nominal" not in scenario.variations:
        yield failed(
            "plants",
            f"no variation 'nominal'; it has {list(scenario.variations)}",
            "add `nominal: {}` under 'variations': the plant of the training episodes",
        )
        state.scenario = None
    elif "actual" not in scenario.variations:
        yield failed(
            "plants",
            "no variation 'actual', which `run` and throws simulate",
            "add `actual: {}` under 'variations', with the differences of the real robot",
        )
    else:
        yield passed("plants", ", ".join(scenario.variations))


def _robot(state: _State, scenario: Scenario) -> Iterator[Finding]:
    robot = load_robot(scenario.robot)
    yield passed("robot.yaml", f"'{robot.name}' fits the schema")
    missing = [str(path) for path in robot_files(scenario.robot) if not path.is_file()]
    if missing:
        yield failed("files", f"not found: {missing}", "set 'urdf' to a path beside robot.yaml")
        return
    yield passed("files", "found")
    state.robot = robot


def _kinematics(state: _State, robot: RobotModel) -> Iterator[Finding]:
    kinematics = state.kinematics = RobotKinematics(robot)
    yield passed(
        "bodies and joints",
        f"{len(kinematics.foot_names)} feet, {kinematics.num_joints} joints, "
        f"{kinematics.total_mass:.1f} kg",
    )


def _posture(kinematics: RobotKinematics) -> Iterator[Finding]:
    q = kinematics.standing_positions()
    low, high = kinematics.position_limits.T
    beyond = (kinematics.posture < low) | (kinematics.posture > high)
    if beyond.any():
        names = [name for name, wrong in zip(kinematics.joint_names, beyond, strict=True) if wrong]
        yield failed(
            "joint stops",
            f"the posture is beyond those of {names}",
            within_stops(kinematics, names),
        )
    p_WC = kinematics.contact_positions(q)
    heights = p_WC[:, 2] - kinematics.foot_radii
    if np.ptp(heights) > LEVEL_M:
        high_feet = [
            name
            for name, points in zip(kinematics.foot_names, kinematics.foot_slices, strict=True)
            if heights[points].max() > LEVEL_M
        ]
        yield failed(
            "feet level",
            f"feet {high_feet} hang up to {100 * np.ptp(heights):.1f} cm over the ground",
            level_feet(kinematics),
        )
    else:
        yield passed(
            "feet level",
            f"within {1000 * np.ptp(heights):.1f} mm, base {kinematics.standing_height:.3f} m high",
        )
    corners = convex_hull(p_WC[:, :2].tolist())
    for item, point in (
        ("centre of mass over the feet", kinematics.center_of_mass(q)),
        ("base over the feet", q[4:7]),
    ):
        distance = signed_distance_to_polygon(point[:2], corners)
        if distance > 0:
            yield passed(item, f"{100 * distance:.1f} cm inside their polygon")
        else:
            yield failed(
                item,
                f"{-100 * distance:.1f} cm outside their polygon",
                feet_below(kinematics, point),
            )


def _own(state: _State, scenario: Scenario) -> Iterator[Finding]:
    if state.kinematics is not None:
        yield from scenario.task_class().check_files(scenario, state.kinematics)


def _diagram(state: _State, scenario: Scenario) -> Iterator[Finding]:
    state.loop = scenario.make_loop()
    yield passed("diagram", f"{type(state.loop).__name__} is built")


def _motors(kinematics: RobotKinematics) -> Iterator[Finding]:
    plant, robot = kinematics.plant, kinematics.robot
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    limits = {actuator.joint().name(): actuator.effort_limit() for actuator in actuators}
    without = [name for name in kinematics.joint_names if name not in limits]
    if without:
        yield failed(
            "motors",
            f"joints {without} have none",
            effort_limits(kinematics, without),
        )
    else:
        yield passed("motors", f"one on each of {len(limits)} joints")
    unlimited = [name for name, limit in limits.items() if not np.isfinite(limit)]
    if unlimited:
        yield failed(
            "effort limits",
            f"the motors of joints {unlimited} have none, so that no load is too heavy",
            effort_limits(kinematics, unlimited),
        )
    if robot.joint_gains:
        loose = [
            name
            for name in kinematics.joint_names
            if by_pattern(robot.joint_gains, name, "gains", robot.name) is None
        ]
        if loose:
            yield failed(
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
        yield failed(
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
        yield passed("effort against gravity", f"{100 * max(shares, default=0):.0f} % at most")


def _collisions(robot: RobotModel) -> Iterator[Finding]:
    """Checks whether links that lost their collision meshes have got a shape since."""
    if not robot.without_collision:
        return
    root = read_urdf(Path(robot.source_dir) / robot.urdf).root
    shaped = {link.get("name") for link in root.iter("link") if link.find("collision") is not None}
    bare = [
        name
        for name in robot.without_collision
        if name not in shaped and by_pattern(robot.shapes, name, "shapes", robot.name) is None
    ]
    if not bare:
        yield passed("collision shapes", "every link that lost its meshes has a shape")
        return
    yield warned(
        "collision shapes",
        f"{len(bare)} links have none, as their meshes were left out; everything passes through "
        f"{', '.join(bare)}",
        f"add a <collision> with a box, sphere or capsule [m] to those that touch something, in "
        f"{Path(robot.urdf).name}, or delete them from 'without_collision' in robot.yaml",
    )


def _target(loop: LeggedLoop) -> Iterator[Finding]:
    """Checks that a thrown ball can hit the base."""
    if not isinstance(loop, HasBall):
        return
    plant, robot = loop.plant, loop.robot
    base = plant.GetBodyByName(robot.base, loop.robot_instance)
    bodies = plant.GetBodiesWeldedTo(base)
    count = sum(len(plant.GetCollisionGeometriesForBody(body)) for body in bodies)
    if count:
        yield passed("shape of the base", f"{count} collision shapes for balls to hit")
    else:
        yield failed(
            "shape of the base",
            f"base '{robot.base}' has no collision geometry, so balls fly through it",
            f"add a <collision> with a box as large as the trunk [m] to link '{robot.base}' in "
            f"{Path(robot.urdf).name}; with 'collision: stated', name it under 'shapes' in "
            "robot.yaml",
        )


def _contacts(loop: LeggedLoop) -> Iterator[Finding]:
    plant, robot = loop.plant, loop.robot
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
        yield failed(
            "contact spheres",
            "the model file has no such sphere: " + "; ".join(missing),
            "add a collision sphere to the URDF, or correct contact_points and radius_m [m]",
        )
    else:
        yield passed("contact spheres", f"{loop.kinematics.num_contacts} in the model file")


def _stands(loop: LeggedLoop) -> Iterator[Finding]:
    kinematics = loop.kinematics
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
        yield failed(
            "safe while it stands",
            f"the standing posture violates {wrong}",
            "for 'height' widen 'height_m' under 'safe_set', such as "
            f"[{0.71 * kinematics.standing_height:.3g}, {1.18 * kinematics.standing_height:.3g}] "
            f"[m], which must include the standing height {kinematics.standing_height:.3f}; for "
            "others change 'posture'",
        )
    else:
        yield passed("safe while it stands", "the posture is in the safe set")
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
        yield failed(
            _STANDS,
            message,
            f"if it sinks, raise {scaled_gains(loop.robot.joint_gains, 2.0)}; if it trembles, "
            "halve them; look for shapes that overlap by `check --picture FILE`",
        )
    else:
        yield passed(_STANDS, message)


def _episodes(
    loop: ClosedLoop, num_episodes: int, seed: int, report: StageProgress
) -> Iterator[Finding]:
    episodes, parameters = [], loop.scenario.parameters
    for index in range(num_episodes):
        report("episodes", index, num_episodes)
        episodes.append(run_episode(loop, index, seed=seed))
    report("episodes", num_episodes, num_episodes)
    causes: dict[str, int] = {}
    for episode in episodes:
        if not episode.is_safe:
            causes[episode.cause] = causes.get(episode.cause, 0) + 1
    yield passed("starts can be sampled", f"{num_episodes} episodes simulated")
    lost = sum(episode.num_steps == 0 for episode in episodes)
    if lost > num_episodes / 4:
        yield failed(
            "starts are safe",
            f"{lost} of {num_episodes} episodes begin outside the safe set",
            "narrow the starts, or widen the safe set" + scaled_start(parameters, 0.5),
        )
    if causes.pop(DIVERGED, 0):
        yield failed(
            "simulation", "an episode diverged", "lower time_step_s [s], or the gains; see masses"
        )
    share = sum(causes.values()) / num_episodes
    message = f"{100 * share:.0f} % of {num_episodes} episodes: " + (
        ", ".join(f"{name} {count}" for name, count in causes.items()) or "none"
    )
    low, high = _UNSAFE_SHARES
    if low <= share <= high:
        yield passed("share of unsafe episodes", message)
    else:
        yield failed(
            "share of unsafe episodes",
            message,
            "widen the starts and plans, or narrow the safe set: Γ learns from both kinds"
            + scaled_start(parameters, 1.5)
            if share < low
            else "narrow the starts and plans, or widen the safe set: Γ learns from both kinds"
            + scaled_start(parameters, 0.5),
        )
