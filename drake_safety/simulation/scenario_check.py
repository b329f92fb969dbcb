"""Check of a scenario before rollouts: what is wrong, and how to correct it."""

import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Sphere
from pydrake.systems.analysis import Simulator

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon
from drake_safety.files.progress import StageProgress, ignore
from drake_safety.learning.causes import describe_margin, is_outside
from drake_safety.learning.segments import DIVERGED
from drake_safety.models import load_robot, robot_files
from drake_safety.policies.policy_network import network_kinds
from drake_safety.robots.family import FAMILY
from drake_safety.robots.plausibility import effort_unit, odd_inertias, odd_limits
from drake_safety.simulation.capabilities import FollowsCommands
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.contract import Finding, check_contract, failed, passed
from drake_safety.simulation.hand_over import ITEM as HAND_OVER
from drake_safety.simulation.hand_over import POLICY_REMEDY, check_hand_over
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import HIDDEN_STATE, is_repeatable, run_episode, run_episodes
from drake_safety.simulation.scenario import Scenario, load_scenario, read_scenario

_Check = Generator[Finding, None, None]
_STANDS = "stands for 1 s"
_LEVEL_M = 2e-3  # Largest difference of the feet's heights.
_MATCH_M = 1e-3
_LINE_REMEDY = (
    "the feet touch along a line, over which no servos balance: state soles as 'contact_points' "
    "under 'feet' in robot.yaml [m], or take a policy (new --task walking)"
)
_GAINS_REMEDY = "if it sinks, raise 'joint_gains' in robot.yaml; if it trembles, halve them"
_EFFORT_REMEDY = "state their largest torques under 'effort_limits' in robot.yaml [N·m]"


def check_scenario(
    name: str | Path,
    *,
    num_episodes: int = 16,
    seed: int = 0,
    is_imported: bool = True,
    check_robot: Callable[[RobotKinematics], Iterator[Finding]] | None = None,
    progress: StageProgress = ignore,
) -> Iterator[Finding]:
    """Checks a scenario item by item, cheap items first; errors in its files become findings.

    Args:
        num_episodes: Episodes that estimate the share of unsafe episodes; 0 skips also the margins
            of a policy.
        is_imported: Whether the task is imported, which runs its code; else files are checked.
        check_robot: Further checks of the robot.
    """
    scenario = yield from _guarded("scenario", _scenario, name, is_imported)
    if scenario is None:
        return
    if scenario.robot:
        kinematics = yield from _guarded("robot.yaml", _robot, scenario)
        if kinematics is None:
            return
        yield from _guarded("standing posture", _posture, kinematics)
        yield from _guarded("motors", _motors, kinematics)
        if check_robot is not None:
            yield from _guarded("model file", check_robot, kinematics)
    if not is_imported:
        return
    with suppress(ValueError):  # Which building the diagram finds, too.
        for text in network_kinds(scenario.task_class().model_files(scenario)):
            yield passed("network", text)
    loop = yield from _guarded("diagram", _diagram, scenario)
    if loop is None:
        return
    if isinstance(loop, LeggedLoop):
        yield from _guarded("shapes", _shapes, loop)
        progress(_STANDS, 0, 1)
        yield from _guarded(_STANDS, _stands, loop)
        progress(_STANDS, 1, 1)
    remedy = ""
    if isinstance(loop, FollowsCommands):
        check = partial(check_hand_over, has_margins=num_episodes > 0, progress=progress)
        remedy = yield from _guarded(HAND_OVER, check, loop)
    yield from _guarded("contract", partial(check_contract, seed=seed), loop)
    if num_episodes:
        yield from _guarded("episodes", _episodes, loop, num_episodes, seed, progress, remedy)
    if num_episodes and scenario.family is not None:
        yield from _guarded("family", _family, scenario, num_episodes, seed, progress)


def _guarded(
    item: str, check: Callable[..., Any], *arguments: Any
) -> Generator[Finding, None, Any]:
    """A check's findings and result; an exception is a finding, and the result None."""
    try:
        return (yield from check(*arguments))
    # A user's task may raise anything, and so may Drake; a failed condition of it is SystemExit.
    except (Exception, SystemExit) as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        yield failed(item, f"{kind}{error}", "correct what the message names")
        return None


def _judged(item: str, is_ok: bool, message: str, problem: str, remedy: str) -> Finding:
    return passed(item, message) if is_ok else failed(item, problem, remedy)


def _scenario(name: str | Path, is_imported: bool) -> Generator[Finding, None, Scenario | None]:
    scenario: Scenario = load_scenario(name) if is_imported else read_scenario(name)
    where = "which was not imported; read it before you do"
    if is_imported:
        module = sys.modules[scenario.task_class().__module__]
        where = f"{getattr(module, '__file__', None)}"
    yield passed("scenario", f"'{scenario.name}' fits the schema")
    yield passed("code", f"the scenario runs {scenario.task}, {where}")
    missing = [name for name in ("nominal", "actual") if name not in scenario.variations]
    if missing:
        remedy = "add them: `nominal` is the plant of the training episodes, `actual` that of `run`"
        yield failed("variations", f"there are none named {missing}", remedy)
    return None if "nominal" in missing else scenario


def _robot(scenario: Scenario) -> Generator[Finding, None, RobotKinematics | None]:
    robot = load_robot(scenario.robot)
    yield passed("robot.yaml", f"'{robot.name}' fits the schema")
    if missing := [str(path) for path in robot_files(scenario.robot) if not path.is_file()]:
        yield failed("files", f"not found: {missing}", "set 'urdf' to a path beside robot.yaml")
        return None
    yield passed("files", "found")
    text = robot_files(scenario.robot)[0].read_text(encoding="utf-8")
    if asked := [line.strip() for line in text.splitlines() if "# ASK the motor's" in line]:
        message = f"the limits of {len(asked)} joints are estimates, such as {asked[0]}"
        yield passed("effort limits", message, f"{_EFFORT_REMEDY}, and delete the remark")
    kinematics = RobotKinematics(robot)
    parts = f"{len(kinematics.foot_names)} feet, {kinematics.num_joints} joints"
    yield passed("bodies and joints", f"{parts}, {kinematics.total_mass:.1f} kg")
    return kinematics


def _posture(kinematics: RobotKinematics) -> _Check:
    q = kinematics.standing_positions()
    names, posture = kinematics.joint_names, kinematics.posture
    limits = kinematics.position_limits
    if beyond := [
        f"{name} at {value:g}, between {low:g} and {high:g}"
        for name, value, (low, high) in zip(names, posture, limits, strict=True)
        if not low <= value <= high
    ]:
        remedy = "correct 'posture' in robot.yaml [rad], or the joints' <limit> in the URDF"
        message = f"the posture is beyond them [rad]: {'; '.join(beyond)}"
        yield failed("joint stops", message, remedy)
    p_WC = kinematics.contact_positions(q)
    heights = p_WC[:, 2] - kinematics.foot_radii
    feet = zip(kinematics.foot_names, kinematics.foot_slices, strict=True)
    high_feet = [name for name, points in feet if heights[points].max() > _LEVEL_M]
    spread = np.ptp(heights)
    yield _judged(
        "feet level",
        spread <= _LEVEL_M,
        f"within {1000 * spread:.1f} mm, base {kinematics.standing_height:.3f} m high",
        f"feet {high_feet} hang up to {100 * spread:.1f} cm over the ground",
        "change their joints under 'posture' in robot.yaml [rad], or 'contact_points' and "
        "'radius_m' under 'feet' [m]",
    )
    corners = convex_hull(p_WC[:, :2].tolist())
    if len(corners) < 3:  # No posture helps: whether it balances is simulated.
        return
    center = kinematics.center_of_mass(q)[:2]
    distance = signed_distance_to_polygon(center, corners)
    x, y = center - np.mean(corners, axis=0)
    yield _judged(
        "centre of mass over the feet",
        distance > 0,
        f"{100 * distance:.1f} cm inside their polygon",
        f"{-100 * distance:.1f} cm outside their polygon, at ({x:+.3f}, {y:+.3f}) m",
        "change 'posture' [rad] or 'contact_points' under 'feet' [m] in robot.yaml, or correct "
        "the masses in the URDF [kg]",
    )


def _diagram(scenario: Scenario) -> Generator[Finding, None, ClosedLoop]:
    loop = scenario.make_loop()
    yield passed("diagram", f"{type(loop).__name__} is built")
    return loop


def _motors(kinematics: RobotKinematics) -> _Check:
    plant, robot, limits = kinematics.plant, kinematics.robot, kinematics.effort_limits
    without = [name for name in kinematics.joint_names if name not in limits]
    each, none = f"one on each of {len(limits)} joints", f"joints {without} have none"
    yield _judged("motors", not without, each, none, _EFFORT_REMEDY)
    if unlimited := [name for name, limit in limits.items() if not np.isfinite(limit)]:
        yield failed("effort limits", f"motors of joints {unlimited} have none", _EFFORT_REMEDY)
    loose = [name for name in kinematics.joint_names if robot.gains_of(name) is None]
    if robot.joint_gains and loose:
        yield failed("servo gains", f"joints {loose} have none", "add them under 'joint_gains'")
    q = kinematics.standing_positions()
    kinematics.set_positions(q)
    instance = plant.GetModelInstanceByName(robot.name)
    if odd := odd_limits(plant, kinematics.context, instance, limits)[1]:
        remedy = "correct <limit> in the model file, or 'effort_limits' [N·m] and"
        yield passed("motor limits", odd, f"{remedy} 'velocity_limits' [rad/s] in robot.yaml")
    if odd := odd_inertias(plant, kinematics.context, instance):
        remedy = "correct <inertia>, <mass> and <origin> of these links [kg·m², kg, m] in"
        yield passed("inertias", odd, f"{remedy} {Path(robot.urdf).name}")
    torques = kinematics.gravity_torques(q, np.ones(kinematics.num_contacts, dtype=bool))
    weak, most = [], 0.0
    for name, need in zip(kinematics.joint_names, np.abs(torques), strict=True):
        share = need / limits.get(name, np.inf)
        most = max(most, share)
        if share > 1:
            unit = effort_unit(plant.GetJointByName(name, instance))
            weak.append(f"{name} needs {need:.1f} of {limits[name]:.1f} {unit}")
    yield _judged(
        "effort against gravity",
        not weak,
        f"{100 * most:.0f} % at most",
        "; ".join(weak),
        "check the effort limits' unit [N·m], the masses [kg], or straighten the legs",
    )


def _shapes(loop: LeggedLoop) -> _Check:
    plant, robot = loop.plant, loop.robot
    inspector = loop.GetSubsystemByName("scene_graph").model_inspector()
    missing = []
    for name, foot in robot.feet.items():
        body = plant.GetBodyByName(foot.body, loop.robot_instance)
        spheres = [
            (*inspector.GetPoseInFrame(g).translation(), inspector.GetShape(g).radius())
            for g in plant.GetCollisionGeometriesForBody(body)
            if isinstance(inspector.GetShape(g), Sphere)
        ]
        for point in foot.contact_points:
            stated = (*point, foot.radius_m)
            if not any(np.allclose(stated, sphere, rtol=0, atol=_MATCH_M) for sphere in spheres):
                stated_spheres = [np.round(sphere, 4).tolist() for sphere in spheres] or "none"
                missing.append(f"{name} at {point} r {foot.radius_m}; it has {stated_spheres}")
    yield _judged(
        "contact spheres",
        not missing,
        f"{loop.kinematics.num_contacts} in the model file",
        "the model file has no such sphere (x, y, z, r): " + "; ".join(missing),
        "add a collision sphere to the URDF, or correct contact_points and radius_m [m]",
    )
    context = loop.CreateDefaultContext()
    loop.reset_to(context, None, loop.standing_start())
    query = plant.get_geometry_query_input_port().Eval(plant.GetMyContextFromRoot(context))
    feet = [plant.GetBodyByName(foot.body, loop.robot_instance) for foot in robot.feet.values()]
    allowed = {body.index() for foot in feet for body in plant.GetBodiesWeldedTo(foot)}
    depths: dict[str, float] = {}
    for pair in query.ComputePointPairPenetration():
        frames = map(query.inspector().GetFrameId, (pair.id_A, pair.id_B))
        bodies = [plant.GetBodyFromFrameId(frame) for frame in frames]
        is_ground = plant.world_body().index() in [body.index() for body in bodies]
        if pair.depth < _MATCH_M or not is_ground:
            continue
        for body in bodies:
            if body.model_instance() == loop.robot_instance and body.index() not in allowed:
                depths[body.name()] = max(pair.depth, depths.get(body.name(), 0.0))
    texts = [f"'{name}' by {100 * depth:.1f} cm" for name, depth in depths.items()]
    yield _judged(
        "off the ground",
        not depths,
        "in the standing posture the feet alone touch it",
        f"the robot rests on shapes that reach into the ground: {', '.join(texts)}",
        "make them smaller in the URDF [m]",
    )
    bodies = plant.GetBodiesWeldedTo(plant.GetBodyByName(robot.base, loop.robot_instance))
    count = sum(len(plant.GetCollisionGeometriesForBody(body)) for body in bodies)
    if hasattr(loop, "throw_ball"):
        yield _judged(
            "shape of the base",
            count > 0,
            f"{count} collision shapes for balls to hit",
            f"base '{robot.base}' has no collision geometry, so balls fly through it",
            f"add a <collision> with a box as large as the trunk [m] to link '{robot.base}' in "
            f"{Path(robot.urdf).name}; with 'collision: stated', name it under 'shapes'",
        )


def _stands(loop: LeggedLoop) -> _Check:
    kinematics, height = loop.kinematics, loop.kinematics.standing_height
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset_to(context, None, loop.standing_start())
    simulator.Initialize()
    margins = loop.GetOutputPort("margins").Eval(context).copy()
    simulator.AdvanceTo(1.0)
    q, v = np.split(loop.GetOutputPort("plant_state").Eval(context), [kinematics.num_positions])
    sunk = height - q[6]
    speed = float(np.abs(v[NUM_BASE_VELOCITIES:]).max(initial=0.0))
    is_still = abs(sunk) <= 0.1 * height and speed <= 1.0
    is_wrong = is_outside(margins[:, None])
    wrong = [
        describe_margin(loop.constraint_names[i], margins[i], loop.angular_constraints)
        for i in np.flatnonzero(is_wrong)
    ]
    yield _judged(
        "safe while it stands",
        not wrong,
        "the posture is in the safe set",
        f"the standing posture violates {'; '.join(wrong)}",
        f"change 'posture' in robot.yaml [rad], or 'safe_set': it stands {height:.3f} m high",
    )
    touching = int(np.sum(kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii < 5e-3))
    message = (
        f"after 1 s it has {'sunk' if sunk >= 0.0 else 'risen'} {100 * abs(sunk):.1f} cm, "
        f"{touching} of {kinematics.num_contacts} contact points touch, "
        f"the fastest joint turns at {speed:.2f} rad/s"
    )
    standing = kinematics.contact_positions(kinematics.standing_positions())
    remedy = _GAINS_REMEDY
    if isinstance(loop, FollowsCommands):
        remedy = POLICY_REMEDY
    elif len(convex_hull(standing[:, :2].tolist())) < 3:
        remedy = _LINE_REMEDY
    yield _judged(_STANDS, is_still and touching > 0, message, message, remedy)


def _family(scenario: Scenario, num_episodes: int, seed: int, report: StageProgress) -> _Check:
    episodes = run_episodes(
        scenario,
        num_episodes,
        variation=FAMILY,
        plants=num_episodes,
        seed=seed,
        num_workers=1,
        progress=partial(report, "plants of the family"),
    )
    share = episodes.num_unsafe / num_episodes
    message = f"{100 * share:.0f} % of {num_episodes} episodes, each on a random plant"
    yield _judged(
        "share of unsafe episodes in the family",
        share <= 0.9,
        message,
        f"{message}; expected at most 90 %: Γ learns most from plants that the robot can stand",
        "narrow the ranges of `family`",
    )


def _episodes(
    loop: ClosedLoop, num_episodes: int, seed: int, report: StageProgress, first: str | None
) -> _Check:
    episodes, run = [], partial(run_episode, seed=seed)
    for index in range(num_episodes):
        episodes.append(run(loop, index))
        report("episodes", index + 1, num_episodes)
    longest = max(episodes, key=lambda episode: episode.num_steps)
    yield _judged(
        "repeated episode",
        is_repeatable(longest, loop.scenario.make_loop(loop.variation), run),
        "simulated again after others, it is the same to the last bit",
        f"episode {longest.index}, simulated again after others, {HIDDEN_STATE}",
        "declare it as discrete, continuous or abstract state, or as a parameter",
    )
    causes = Counter(episode.cause for episode in episodes if not episode.is_safe)
    lost = sum(episode.num_steps == 0 for episode in episodes)
    if lost > num_episodes / 4:
        remedy = first or "narrow the ranges under 'start' in the scenario, or widen 'safe_set'"
        message = f"{lost} of {num_episodes} episodes begin outside the safe set"
        yield failed("starts are safe", message, remedy)
    if causes.pop(DIVERGED, 0):
        remedy = "lower time_step_s [s], or the gains; see masses"
        yield failed("simulation", "an episode diverged", remedy)
    share = sum(causes.values()) / num_episodes
    counts = ", ".join(f"{name} {count}" for name, count in causes.items()) or "none"
    message = f"{100 * share:.0f} % of {num_episodes} episodes: {counts}"
    change, other = ("widen", "narrow") if share < 0.1 else ("narrow", "widen")
    yield _judged(
        "share of unsafe episodes",
        0.1 <= share <= 0.9,
        message,
        f"{message}; expected 10 to 90 %: Γ learns from both",
        first or f"{change} the ranges of starts and plans in the scenario, or {other} 'safe_set'",
    )
