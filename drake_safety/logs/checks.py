"""Checks of a log as its map reads it: what is implausible, or contradicts itself, is refused.

Velocities and positions are compared by their changes in short windows; standing feet do not slide.
"""

import itertools
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.observation import quaternion_of
from drake_safety.logs.conversion import Source, common_span, values_at
from drake_safety.logs.log_map import ANGLE_UNITS, LENGTH_UNITS, VELOCITIES, si_units

_NORM_TOLERANCE = 0.01
_MAX_TILT_RAD = math.radians(60.0)
_FOOT_SHARE = 0.2  # Largest height of the lowest foot, relative to the standing height.
_FAR_RAD = 0.3  # Largest excess over a joint stop by servo errors and encoder offsets.
_REACH_SHARE = 3.0  # Largest distance of z* from the base, relative to the standing height.
_LOW_BASE, _LOW_HAND = 0.5, 0.2  # Least height of z*, relative to it; the largest is the inverse.
_WINDOWS_S, _MANY_WINDOWS = (0.1, 0.5), 400  # For fast and for slow motion.
_LONG_S, _MANY_LONG, _MANY_ROWS = 0.45, 4, 10  # Long windows in a log, and rows in one, at least.
# Least change in a window, and difference, that tells motion from noise [m, rad].
_LEAST = {"base_linear_velocity": 0.01, "base_angular_velocity": 0.05, "joint_velocities": 0.1}
_DISAGREES, _AGREES = 0.4, 0.25  # Shares of the motion, if another reading agrees.
_DISAGREES_LONG, _CLEARLY = 0.2, 0.25  # In long windows, and the other reading's share of it.
_WRONG, _FAR = 0.9, 3.0  # Share of the motion, and of the least change, if no reading agrees.
_FACTOR, _TURN_RAD = 1.6, math.radians(30.0)  # Least factor of a unit or rate, and turn of axes.
_FASTEST_M_S, _FASTEST_RAD_S = 15.0, 40.0  # Speeds of the base; gyroscopes measure less.
_FASTEST_JOINT = (20.0, 100.0)  # Range of the limit [rad/s].
_JUMP_S = 0.005
_STEP_S, _NUM_STEPS = 0.05, 80  # Windows in which a foot on the ground does not move.
_SHORTEST_S = 0.5  # Shortest log that shows how feet move.
_SLIP_M, _SLIP_FACTOR, _HIGH_M = 0.004, 3.0, 0.01
_LONGEST_LEG = 7
_MEASURES = ("from their means", "while the lowest one stands", "or rest at several heights")
_MIRRORS = {"left and right": (1, -1), "front and rear": (-1, 1)}
_INVERSE = "'base_orientation' is the inverse, of the world in the base"

# A reading in words, and the changes by positions and by velocities in it, (M, n) each.
_Reading = tuple[str, np.ndarray, np.ndarray]


class _Pose(NamedTuple):
    """A reading of pose and joints: whether the robot stands at first, and how its feet rest."""

    what: str
    stands: bool
    slips: list[float]  # By every measure [m].
    height: float  # Height of all feet [m].
    rest: np.ndarray  # Motion and distance from that height of each foot in its best fifth [m].


def check(sources: list[Source], kinematics: RobotKinematics) -> list[str]:
    """Checks the first piece's start, the longest one's motion, and all values; returns notes."""
    longest, notes = max(sources, key=lambda source: float(np.ptp(source.at_s))), list[str]()
    for source in sources:
        norms = np.linalg.norm(source.table("base_orientation"), axis=1)
        if (is_bad := np.abs(norms - 1.0) > _NORM_TOLERANCE).any():
            row = int(np.argmax(is_bad))
            where = source.channels["base_orientation"].where(row)
            where += f", columns {source.log_map.base_orientation.columns}"
            raise ValueError(f"{where}: the quaternion has a norm of {norms[row]:g}, expected 1")
        if source is sources[0]:
            _check_start(source, kinematics)
        if beyond := _beyond_stops(kinematics, source.table("joint_positions")):
            row, joint, text = beyond
            column = source.log_map.joint_positions.column(source.joints[joint])
            raise ValueError(f"{source.channels['joint_positions'].where(row, column)}: {text}")
        for name in VELOCITIES.values():
            _check_speed(source, name, kinematics)
        if source is longest:
            notes = _check_stance(source, kinematics)
            _check_velocities(source)
        for name in VELOCITIES.keys() & source.channels.keys():
            _check_speed(source, name, kinematics)
    return notes


def _check_speed(source: Source, name: str, kinematics: RobotKinematics) -> None:
    """Checks that a quantity nowhere moves, or jumps between two rows, as no robot does."""
    channel, values = source.channels[name], source.table(name)
    is_angle = "angular" in name or "orientation" in name
    limit = np.array(_FASTEST_RAD_S if is_angle else _FASTEST_M_S)
    if "joint" in name:
        own = kinematics.velocity_limits
        limit = np.clip(np.where(own > 1.0, 2 * own, math.inf), *_FASTEST_JOINT)
    speeds, jump = np.abs(values), ""
    if name not in VELOCITIES:
        jump = " since the row before"
        speeds = np.abs(np.diff(values, axis=0, prepend=values[:1]))
        if name == "base_orientation":
            cosines = np.sum(values[1:] * values[:-1], axis=1)
            speeds[1:] = 2 * np.arccos(np.minimum(np.abs(cosines), 1.0))[:, None]
        steps_s = np.diff(channel.time_s)[:, None]
        # Rare jumps take 5 ms at least, so that noise does not reach the limits.
        is_usual = (np.median(speeds[1:] / steps_s, axis=0) > limit).any()
        speeds[1:] /= steps_s if is_usual else np.maximum(steps_s, _JUMP_S)
    if not (is_beyond := speeds > limit).any():
        return
    row = int(np.argmax(is_beyond.any(axis=1)))
    column = int(np.argmax(speeds[row] / limit))
    where = channel.where(row, getattr(source.log_map, name).names(source.joints)[column])
    raise ValueError(
        f"{where}: the value is {channel.frame.iloc[row].iloc[column]:g}, which means "
        f"{speeds[row, column]:.3g} {'rad/s' if is_angle or 'joint' in name else 'm/s'}{jump}; "
        f"robots stay below {np.broadcast_to(limit, speeds.shape)[row, column]:g}: check units, "
        f"and that all rows of '{name}' are of one source"
    )


def _implausible(kinematics: RobotKinematics, q: np.ndarray) -> str:
    """Returns why a robot at positions (n_q,) does not stand on the ground z = 0, or ""."""
    if beyond := _beyond_stops(kinematics, q[None, 7:]):
        return beyond[2]
    up = quaternion_of(q).rotation()[2, 2]
    if (tilt := math.acos(min(max(up, -1.0), 1.0))) > _MAX_TILT_RAD:
        return f"its base is tilted by {math.degrees(tilt):.0f}° from upright"
    height = _lowest_foot(kinematics, q)
    if abs(height) > _FOOT_SHARE * kinematics.standing_height:
        return f"its lowest foot is {_side(height)} the ground"
    return ""


def _lowest_foot(kinematics: RobotKinematics, q: np.ndarray) -> float:
    return float((kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii).min())


def _beyond_stops(kinematics: RobotKinematics, joints: np.ndarray) -> tuple[int, int, str] | None:
    """The first row of joints (N, n_j) [rad] with one far beyond its stops, and which and where."""
    low, high = kinematics.position_limits.T
    excess = np.maximum(low - joints, joints - high)
    row = int(np.argmax((excess > _FAR_RAD).any(axis=1)))
    joint = int(np.argmax(excess[row]))
    if not excess[row, joint] > _FAR_RAD:
        return None
    text = f"joint '{kinematics.joint_names[joint]}' is at {joints[row, joint]:.3g} rad"
    return row, joint, f"{text}, far beyond its stops {low[joint]:.3g} and {high[joint]:.3g}"


def _check_start(source: Source, kinematics: RobotKinematics) -> None:
    """Checks that the robot stands on the ground in the first row; else says how it would."""

    def wrong(read: Source) -> str:
        return _implausible(kinematics, read.positions(source.at_s[:1])[0])

    if not (reason := wrong(source)):
        _check_desired_output(source, kinematics)
        return
    likely = []
    for name, units in (("joint_positions", ANGLE_UNITS), ("base_position", LENGTH_UNITS)):
        part = getattr(source.log_map, name)
        for unit in units:
            log_map = replace(source.log_map, **{name: replace(part, unit=unit)})
            if unit != part.unit and not wrong(replace(source, log_map=log_map)):
                likely.append(f"'{name}.unit' is {unit}")
    poses = list(_poses(source, kinematics))
    if best := _stillest([pose for pose in poses if "joint" not in pose.what], 1):
        likely.append(best.what)
    if not likely:
        likely = [best.what] if (best := _stillest(poses, 1)) else []
        q = source.positions(source.at_s[:1])[0]
        height = _lowest_foot(kinematics, q)
        q[6] -= height
        is_near = abs(height) < _REACH_SHARE * kinematics.standing_height
        if is_near and not _implausible(kinematics, q):
            side = "lower" if height > 0 else "higher"
            likely.append(f"it were {abs(height):.3g} m {side}: {_offset_text(source, height)}")
    hint = f"; it would stand if {' or '.join(likely)}" if likely else ""
    what = f"robot '{kinematics.robot.name}' does not stand on the ground z = 0 at the start"
    raise ValueError(f"{source.where}: {what}: {reason}{hint}")


def _check_desired_output(source: Source, kinematics: RobotKinematics) -> None:
    if "desired_output" not in source.channels:
        return
    desired, base = (source.at(n, source.at_s[:1])[0] for n in ("desired_output", "base_position"))
    low = _LOW_HAND if kinematics.robot.reaching_frames else _LOW_BASE
    height, unit = kinematics.standing_height, si_units(source.log_map.desired_output)
    reach = _REACH_SHARE * height

    def is_near(z: np.ndarray) -> bool:
        return bool(low < z[2] / height < 1 / low and np.linalg.norm(z - base) <= reach)

    if is_near(desired):
        return
    units = [one for one, size in LENGTH_UNITS.items() if is_near(size / unit * desired)]
    got = f"{np.linalg.norm(desired - base):.3g} m from the robot's base, at z = {desired[2]:.3g} m"
    near = f"within {reach:.3g} m, at z = {low * height:.3g} to {height / low:.3g} m"
    what = f"the desired output is {got}; expected a position, no velocity, {near}"
    hint = f"it fits if 'desired_output.unit' is {units[0]}" if units else "check columns and unit"
    raise ValueError(f"{source.where}: {what}: {hint}")


def _check_stance(source: Source, kinematics: RobotKinematics) -> list[str]:
    """Checks that feet rest best as the map reads them; notes their height over the ground."""
    if np.ptp(source.at_s) < _SHORTEST_S:
        return []
    poses = _poses(source, kinematics)
    given = next(poses)
    others = list(poses) if max(given.slips) > _SLIP_M else []
    for i, measure in enumerate(_MEASURES):
        best, slip = _stillest(others, i) or given, given.slips[i]
        if slip > max(_SLIP_M, _SLIP_FACTOR * best.slips[i]):
            better = f"only by {best.slips[i]:.3g} m if {best.what}"
            worse = f"the feet slide by {slip:.3g} m with the base ({measure})"
            raise ValueError(f"{source.where} and after it: {worse}, but {better}")
    if abs(height := given.height) < _HIGH_M:
        return []
    text = f"{source.where} and after it: the feet rest {_side(height)} the ground z = 0"
    return [f"{text}: {_offset_text(source, height)} would put them on it"]


def _side(height: float) -> str:
    return f"{abs(height):.3g} m {'above' if height > 0 else 'below'}"


def _offset_text(source: Source, height: float) -> str:
    """The map's offset that lowers the base by a height [m]."""
    part = source.log_map.base_position
    offset = part.offset.get(column := part.columns[2], 0.0) - height / si_units(part)
    return f"'base_position.offset' of {{{column}: {offset:.4g}}}{_also(source)}"


def _also(source: Source) -> str:
    return " (and of 'desired_output')" if "desired_output" in source.channels else ""


def _stillest(poses: list[_Pose], i: int) -> _Pose | None:
    """The first of the poses in which a robot stands whose feet slide least, to a millimetre."""
    standing = [pose for pose in poses if pose.stands]
    least = min((pose.slips[i] for pose in standing), default=0.0)
    return next((pose for pose in standing if pose.slips[i] <= least + 0.001), None)


def _poses(source: Source, kinematics: RobotKinematics) -> Iterator[_Pose]:
    """The feet by each reading of pose and joints, the map's reading first."""
    at_s = source.at_s
    step = max(_STEP_S, float(np.diff(at_s).max(initial=0.0)))
    begins = np.linspace(at_s[0], max(at_s[-1] - step, at_s[0]), _NUM_STEPS)
    q = source.positions(np.concatenate([begins, begins + step]))
    R_WB, p_WB, joints = Rotation.from_quat(q[:, :4], scalar_first=True), q[:, 4:7], q[:, 7:]

    def contacts(joints: np.ndarray) -> np.ndarray:
        upright = np.hstack([np.tile([1.0, *np.zeros(6)], (len(q), 1)), joints])
        return np.array([kinematics.contact_positions(one) for one in upright])

    def pose(what: str, R: Rotation, p: np.ndarray, joints: np.ndarray, p_BC: np.ndarray) -> _Pose:
        feet = p[:, None] + np.einsum("nij,ncj->nci", R.as_matrix(), p_BC)
        first, last = np.split(feet, 2)
        lowest = np.argmin(first[..., 2] + last[..., 2], axis=1)
        moved, high = np.linalg.norm(last - first, axis=2), first[..., 2] - kinematics.foot_radii
        slices = kinematics.foot_slices
        height = np.median([np.quantile(high[:, s].min(axis=1), 0.2) for s in slices])
        rest = [np.quantile((moved + abs(high - height))[:, s].mean(1), 0.2) for s in slices]
        start = np.concatenate([R[0].as_quat(scalar_first=True), p[0], joints[0]])
        rms = np.sqrt(np.mean((feet - feet.mean(axis=0)) ** 2))
        slips = rms, np.median(moved[np.arange(_NUM_STEPS), lowest]), np.mean(rest)
        stands = not _implausible(kinematics, start)
        return _Pose(what, stands, list(map(float, slips)), float(height), np.array(rest))

    p_BC = contacts(joints)
    for what, R, p in _readings(source.log_map.base_orientation.order, R_WB, p_WB):
        yield pose(what, R, p, joints, p_BC)
    for what, p in _mirrored(source, "base_position", p_WB):
        yield pose(what + _also(source), R_WB, p, joints, p_BC)
    feet = kinematics.robot.feet.values()
    legs = [np.array([source.joints.index(name) for name in foot.joints]) for foot in feet]
    if len(set(map(len, legs))) > 1 or len(legs[0]) > _LONGEST_LEG:
        return
    columns = source.log_map.joint_positions.names(source.joints)
    ends = np.array([kinematics.nominal_contacts[s].mean(axis=0) for s in kinematics.foot_slices])
    for which, mirror in _MIRRORS.items():
        order = np.linalg.norm(ends[:, None] * mirror - ends, axis=2).argmin(axis=1)
        read = joints.copy()
        read[:, np.concatenate(legs)] = joints[:, np.concatenate([legs[i] for i in order])]
        named = {source.joints[legs[0][0]]: columns[legs[order[0]][0]]}
        what = f"'joint_positions.columns' of {which} legs are exchanged: {named} and so on"
        yield pose(what, R_WB, p_WB, read, contacts(read))
    signs = sorted(itertools.product([1, -1], repeat=len(legs[0])), key=lambda one: -sum(one))
    factors = np.ones((len(signs), joints.shape[1]))
    for leg in legs:
        factors[:, leg] = signs
    turned = factors[:, None] * joints
    rests = np.array([pose("", R_WB, p_WB, read, contacts(read)).rest for read in turned])
    best = np.argmax(rests <= rests.min(axis=0) + 0.001, axis=0)
    for leg, i in zip(legs, best, strict=True):
        factors[0, leg] = signs[i]
    named = {columns[i]: -1 for i in np.flatnonzero(factors[0] < 0)}
    read = factors[0] * joints
    yield pose(f"'joint_positions.sign' is {named}", R_WB, p_WB, read, contacts(read))


def _mirrored(source: Source, name: str, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Readings of x, y, z (N, 3) with one of them reversed, or two exchanged."""
    part = getattr(source.log_map, name)
    for i, k in itertools.combinations_with_replacement(range(3), 2):
        read, one = values.copy(), part.columns[i]
        read[:, [i, k]] = values[:, [k, i]] * (-1 if i == k else 1)
        sign = f"'{name}.sign' is {{{one}: {-part.sign.get(one, 1)}}}"
        yield sign if i == k else f"columns '{one}' and '{part.columns[k]}' are exchanged", read


def _readings(order: str, R: Rotation, p: np.ndarray) -> Iterator[tuple[str, Rotation, np.ndarray]]:
    """Readings of the base's orientation (N,) and position (N, 3)."""
    swapped = R.as_quat(scalar_first=order == "wxyz")
    other = Rotation.from_quat(swapped, scalar_first=order != "wxyz")
    text = f"'base_orientation.order' is {'xyzw' if order == 'wxyz' else 'wxyz'}"
    yield "", R, p
    yield text, other, p
    yield _INVERSE, R.inv(), p
    yield "the whole pose is the inverse, of the world in the base", R.inv(), -R.inv().apply(p)
    quarters = [turn for turn in Rotation.create_group("O") if turn.magnitude() > 0]
    for turn in sorted(quarters, key=lambda turn: np.count_nonzero(abs(turn.as_rotvec()) > 1e-6)):
        what = f"'base_orientation' is of a sensor turned on the base by {_turn_text(turn)}"
        yield what, R * turn.inv(), p
    for angle in (*range(-170, 0, 10), *range(10, 180, 10)):
        what = f"'base_orientation' is turned by {-angle}° about the vertical of the world"
        yield what, Rotation.from_euler("z", angle, degrees=True) * R, p


def _check_velocities(source: Source) -> None:
    """Checks that logged velocities are the derivatives of positions, in frame, sign and unit."""
    for window_s, (name, positions) in itertools.product(_WINDOWS_S, VELOCITIES.items()):
        if name not in source.channels:
            continue
        names = {positions, name} if "joint" in name else {positions, name, "base_orientation"}
        channels = [source.channels[other] for other in names]
        begin, end = common_span(channels)
        step = max(float(np.median(np.diff(channel.time_s))) for channel in channels)
        width = min(max(window_s, 2 * step), end - begin)
        is_long = window_s > _LONG_S
        if is_long and (end - begin < _MANY_LONG * width or width < _MANY_ROWS * step):
            continue
        number = 1 + int(min((end - begin - width) / step + 1e-6, _MANY_WINDOWS))
        windows = np.linspace(begin, end - width, number) + np.array([[0.0], [width]])
        time_s = source.channels[name].time_s
        sums = cumulative_trapezoid(source.table(name), time_s, axis=0, initial=0.0)
        logged = np.subtract(*(values_at(time_s, sums, at_s) for at_s in windows[::-1]))
        moved = np.subtract(*(source.at(positions, at_s) for at_s in windows[::-1]))
        if name != "joint_velocities":
            _check_base(source, name, moved, logged, windows)
            continue
        moved, logged = (_without_drift(one, width) for one in (moved, logged))
        for i, column in enumerate(source.log_map.joint_velocities.names(source.joints)):
            given = "", moved[:, [i]], logged[:, [i]]
            readings = _scaled(source, name, *given[1:])
            for k, joint in enumerate(source.joints):
                readings.append((f"it is of joint '{joint}'", moved[:, [k]], given[2]))
            if not moved[:, i].any():
                angle = source.log_map.joint_positions.column(source.joints[i])
                readings = [(f"the encoder of '{angle}' is dead", given[2], given[2])] * is_long
            _require(source, name, [column], width, given, readings)


def _without_drift(change: np.ndarray, width_s: float) -> np.ndarray:
    """Changes in windows without their mean if these are long, so that a bias is no motion."""
    return change - change.mean(axis=0) if width_s > _LONG_S else change


def _check_base(
    source: Source, name: str, moved: np.ndarray, logged: np.ndarray, windows: np.ndarray
) -> None:
    def derived(begin: Rotation, end: Rotation, middle: Rotation) -> dict[str, np.ndarray]:
        change = moved if "linear" in name else (end * begin.inv()).as_rotvec()
        both = {"world": change, "body": middle.inv().apply(change)}
        return {frame: _without_drift(one, width) for frame, one in both.items()}

    part, width = getattr(source.log_map, name), float(windows[1, 0] - windows[0, 0])
    logged = _without_drift(logged, width)
    frame, other = part.frame, "body" if part.frame == "world" else "world"
    turns = [source.rotations_at(at_s) for at_s in (*windows, windows.mean(axis=0))]
    changes, inverse = derived(*turns), derived(*(one.inv() for one in turns))
    in_other = f"'{name}.frame' is {other}"
    simple = [(in_other, changes[other], logged), (_INVERSE, inverse[frame], logged)]
    turned = [(what, changes[frame], one) for what, one in _mirrored(source, name, logged)]
    for change, also in ((changes[frame], ""), (changes[other], f" and {in_other}")):
        simple += _scaled(source, name, change, logged, also)
        if len(logged) > 1 and logged.any() and change.any():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # About motion along one axis alone.
                turn = Rotation.align_vectors(change, logged)[0]
            if turn.magnitude() > _TURN_RAD:
                text = f"its axes, or the base's, are turned by {_turn_text(turn)} in the "
                turned.append((text + (other if also else frame), change, turn.apply(logged)))
    _require(source, name, part.columns, width, ("", changes[frame], logged), simple, turned)


def _scaled(
    source: Source, name: str, derived: np.ndarray, logged: np.ndarray, also: str = ""
) -> list[_Reading]:
    """The reading with another sign, unit or rate, if there is one."""
    factor = float((derived * logged).sum() / max((logged**2).sum(), 1e-12))
    if 1 / _FACTOR < factor < _FACTOR or factor == 0:
        return []
    units = LENGTH_UNITS if "linear" in name else ANGLE_UNITS
    unit = si_units(getattr(source.log_map, name))
    known = {size / unit: f"'{name}.unit' is {one}" for one, size in units.items()}
    known[-1.0] = "its sign is reversed"
    near = [what for one, what in known.items() if abs(factor / one - 1) < 0.2]
    text = f"it is multiplied by {factor:.3g}: a gear ratio, a unit, or the rate of time"
    return [([*near, text][0] + also, derived, factor * logged)]


def _require(
    source: Source, name: str, columns: list[str], width_s: float, given: _Reading, *tiers: Any
) -> None:
    """Raises if the given reading differs and one of a tier does not, or if it differs by far."""

    def sizes(derived: np.ndarray, logged: np.ndarray) -> np.ndarray:
        return np.linalg.norm([derived, logged], axis=2).max(axis=0)

    def differs(derived: np.ndarray, logged: np.ndarray) -> tuple[float, float]:
        """Median difference in the windows with motion, relative to it and absolute."""
        size = float(np.median(np.linalg.norm(derived - logged, axis=1)[moves]))
        return size / float(np.median(sizes(derived, logged)[moves])), size

    changes, least, is_long = sizes(*given[1:]), _LEAST[name], width_s > _LONG_S
    # All long windows count: noise would choose among them.
    moves = np.full(len(changes), np.median(changes) > least / 2) if is_long else changes > least
    share, size = differs(*given[1:]) if moves.any() else (0.0, 0.0)
    if share <= (_DISAGREES_LONG if is_long else _DISAGREES) or (size < least and not is_long):
        return
    unit = "m/s" if "linear" in name else "rad/s"
    text = (
        f"log '{source.channels[name].path}', '{name}', columns {columns}: they differ from the "
        f"derivative of '{VELOCITIES[name]}' by {size / width_s:.2f} {unit}, median where it moves"
    )
    for tier in tiers:
        shares = [(*differs(*both), what) for what, *both in tier]
        best = min((other[0] for other in shares), default=math.inf)
        if best < min(_AGREES, share * (_CLEARLY if is_long else 0.5)):
            close = [other for other in shares if other[0] < best + 0.05][:2]
            likely = " or ".join(what for _, _, what in close)
            raise ValueError(f"{text}, but by {close[0][1] / width_s:.2f} {unit} if {likely}")
    num_rows = 8 if "angular" in name else 4  # A gyroscope's vibrations need more to be averaged.
    is_still = any(not np.median(np.linalg.norm(part, axis=1)[moves]) for part in given[1:])
    is_far = not is_long and share > _WRONG and (size > _FAR * least or is_still)
    if is_far and width_s > num_rows * np.median(np.diff(source.channels[name].time_s)):
        remedy = f"leave '{name}' out of the map, unless '{VELOCITIES[name]}' stands still"
        raise ValueError(f"{text}; no other frame, sign or unit agrees: {remedy}")


def _turn_text(turn: Rotation) -> str:
    axis = ((turn.as_rotvec() / turn.magnitude()).round(2) + 0.0).tolist()
    vertical = " (the vertical)" if abs(axis[2]) == 1 else ""
    return f"{math.degrees(turn.magnitude()):.0f}° about {axis}{vertical}"
