"""Contradictions: what a log says twice must agree as its map reads it, else the map is wrong.

Velocities are compared with positions by their changes in short windows, which noise and a low rate
spoil less than derivatives; feet that stand must not slide. An error names the reading that agrees.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.logs import checks
from drake_safety.logs.conversion import Source, values_at
from drake_safety.logs.log_map import ANGLE_UNITS, LENGTH_UNITS, ORDERS, VELOCITIES, si_units

_WINDOW_S, _MANY_WINDOWS = 0.1, 400
_LEAST = {"base_linear_velocity": 0.01, "base_angular_velocity": 0.05, "joint_velocities": 0.1}
"""Least change in a window, and difference, that tells motion from noise [m, rad]."""
_DISAGREES, _AGREES = 0.4, 0.25  # Of the motion, if another reading agrees.
_WRONG, _FAR = 0.9, 3.0  # Of the motion, and of the least change, if none does.
_FACTOR, _TURN_RAD = 1.6, math.radians(30.0)  # Least factor of a unit or rate, and turn of axes.
_STEP_S, _NUM_STEPS = 0.05, 80  # In which a foot on the ground does not move.
_SHORTEST_S = 0.5  # Of a log that says how feet move.
_SLIP_M, _SLIP_FACTOR = 0.004, 3.0
_INVERSE = "'base_orientation' is the inverse, of the world in the base"

_Reading = tuple[str, np.ndarray, np.ndarray]
"""Another reading in words, and the changes by positions and by velocities in it, (M, n)."""
_Pose = tuple[str, bool, tuple[float, float]]
"""A reading of the base's pose: whether the robot stands at first, and how its feet slide [m]."""


def check_velocities(source: Source) -> None:
    """Checks that logged velocities are the derivatives of positions, in frame, sign and unit.

    Raises:
        ValueError: Changes in windows of 0.1 s differ, in median, by more than 0.4 of the motion,
            and by less than 0.25 and half as much in another reading; or by more than 0.9.
    """
    for name, positions in VELOCITIES.items():
        if name not in source.channels:
            continue
        names = {positions, name} if "joint" in name else {positions, name, "base_orientation"}
        times = [source.times[one] for one in names]
        begin, end = max(one[0] for one in times), min(one[-1] for one in times)
        step = max(float(np.median(np.diff(one))) for one in times)
        width = min(max(_WINDOW_S, 2 * step), end - begin)
        number = 1 + int(min((end - begin - width) / step + 1e-6, _MANY_WINDOWS))
        windows = np.linspace(begin, end - width, number) + np.array([[0.0], [width]])
        sums = cumulative_trapezoid(source.table(name), source.times[name], axis=0, initial=0.0)
        logged = np.subtract(*(values_at(source.times[name], sums, at_s) for at_s in windows[::-1]))
        moved = np.subtract(*(source.at(positions, at_s) for at_s in windows[::-1]))
        if name == "joint_velocities":
            _check_joints(source, moved, logged, windows)
        else:
            _check_base(source, name, moved, logged, windows)


def _check_base(
    source: Source, name: str, moved: np.ndarray, logged: np.ndarray, windows: np.ndarray
) -> None:
    begin, end, middle = (source.rotations_at(at_s) for at_s in (*windows, windows.mean(axis=0)))
    is_linear = name == "base_linear_velocity"
    if not is_linear:
        moved = (end * begin.inv()).as_rotvec()
    derived = {"world": moved, "body": middle.inv().apply(moved)}
    part = getattr(source.log_map, name)
    frame, other = part.frame, "body" if part.frame == "world" else "world"
    simple: list[_Reading] = [(f"'{name}.frame' is {other}", derived[other], logged)]
    if not is_linear or frame == "body":
        simple.append((_INVERSE, middle.apply(moved) if is_linear else -derived[other], logged))
    turned: list[_Reading] = []
    for one, also in ((frame, ""), (other, f" and '{name}.frame' is {other}")):
        simple += _scaled(source, name, derived[one], logged, also)
        if len(logged) > 1 and logged.any() and derived[one].any():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # About motion along one axis alone.
                turn = Rotation.align_vectors(derived[one], logged)[0]
            if turn.magnitude() > _TURN_RAD:
                what = f"its axes, or the base's, are turned by {_turn_text(turn)} in the {one}"
                turned.append((what, derived[one], turn.apply(logged)))
    _require(source, name, part.columns, ("", derived[frame], logged), (simple, turned), windows)


def _check_joints(
    source: Source, moved: np.ndarray, logged: np.ndarray, windows: np.ndarray
) -> None:
    name, joints = "joint_velocities", source.joints
    for i, column in enumerate(source.log_map.joint_velocities.names(joints)):
        given = moved[:, [i]], logged[:, [i]]
        others: list[_Reading] = [
            (f"it is of joint '{joint}'", moved[:, [k]], given[1])
            for k, joint in enumerate(joints)
            if k != i
        ]
        readings = _scaled(source, name, *given, "") + others
        _require(source, name, [column], ("", *given), (readings,), windows)


def _scaled(
    source: Source, name: str, derived: np.ndarray, logged: np.ndarray, also: str
) -> list[_Reading]:
    """The reading with another sign, unit or rate, if there is one."""
    factor = float((derived * logged).sum() / max((logged**2).sum(), 1e-12))
    if 1 / _FACTOR < factor < _FACTOR or factor == 0:
        return []
    units = LENGTH_UNITS if name == "base_linear_velocity" else ANGLE_UNITS
    unit = si_units(getattr(source.log_map, name))
    known = {-1.0: "its sign is reversed"}
    known |= {size / unit: f"'{name}.unit' is {one}" for one, size in units.items()}
    near = [what for one, what in known.items() if abs(factor / one - 1) < 0.2]
    text = f"it is multiplied by {factor:.3g}: a gear ratio, a unit, or the rate of time"
    return [((near or [text])[0] + also, derived, factor * logged)]


def _require(
    source: Source,
    name: str,
    columns: list[str],
    given: _Reading,
    tiers: tuple[list[_Reading], ...],
    windows: np.ndarray,
) -> None:
    """Raises if the given reading differs and one of a tier does not, or if it differs by far."""

    def sizes(changes: Iterable[np.ndarray]) -> np.ndarray:
        return np.maximum(*(np.linalg.norm(one, axis=1) for one in changes))

    def differs(reading: _Reading) -> tuple[float, float, str]:
        """Median difference in the windows with motion, relative to it and absolute."""
        derived, logged = (one[moves] for one in reading[1:])
        size = float(np.median(np.linalg.norm(derived - logged, axis=1)))
        return size / float(np.median(sizes((derived, logged)))), size, reading[0]

    moves = sizes(given[1:]) > _LEAST[name]
    share, size, _ = differs(given) if moves.any() else (0.0, 0.0, "")
    if share <= _DISAGREES or size < _LEAST[name]:
        return
    width, unit = windows[1, 0] - windows[0, 0], "m/s" if "linear" in name else "rad/s"
    text = (
        f"log '{source.channels[name].path}', '{name}', columns {columns}: they differ from the "
        f"derivative of '{VELOCITIES[name]}' by {size / width:.2f} {unit}, median where it moves"
    )
    for tier in tiers:
        found = [differs(one) for one in tier]
        best = min((one[0] for one in found), default=math.inf)
        if best < min(_AGREES, share / 2):
            close = [one for one in found if one[0] < best + 0.05][:2]
            likely = " or ".join(what for _, _, what in close)
            raise ValueError(f"{text}, but by {close[0][1] / width:.2f} {unit} if {likely}")
    num_rows = 8 if "angular" in name else 4  # A gyroscope's vibrations need more to be averaged.
    is_far = share > _WRONG and (size > _FAR * _LEAST[name] or not given[2].any())
    if is_far and width > num_rows * np.median(source.channels[name].steps_s()):
        raise ValueError(
            f"{text}; no other frame, sign or unit agrees: leave '{name}' out of the map, then the "
            "derivative is used"
        )


def _turn_text(turn: Rotation) -> str:
    axis = ((turn.as_rotvec() / turn.magnitude()).round(2) + 0.0).tolist()
    vertical = " (the vertical)" if abs(axis[2]) == 1 else ""
    return f"{math.degrees(turn.magnitude()):.0f}° about {axis}{vertical}"


def check_stance(source: Source, kinematics: RobotKinematics) -> None:
    """Checks that feet slide no less by another reading of the base's orientation.

    Raises:
        ValueError: The contact points move by more than 4 mm, and by three times as much as in
            another reading: from their means (rms), or the lowest one in 0.05 s (median).
    """
    if np.ptp(source.at_s) < _SHORTEST_S:
        return
    given, *others = _poses(source, kinematics)
    for i, how in enumerate(("from their means", "while the lowest one stands")):
        what, _, slips = _stillest(others, i) or given
        if given[2][i] > max(_SLIP_M, _SLIP_FACTOR * slips[i]):
            raise ValueError(
                f"{source.where} and after it: columns {source.log_map.base_orientation.columns}: "
                f"the feet of robot '{kinematics.robot.name}' slide by {given[2][i]:.3g} m with "
                f"the base ({how}), but only by {slips[i]:.3g} m if {what}"
            )


def _stillest(poses: Iterable[_Pose], i: int) -> _Pose | None:
    """The first of the poses in which a robot stands whose feet slide least, to a millimetre."""
    standing = [one for one in poses if one[1]]
    least = min((slips[i] for _, _, slips in standing), default=0.0)
    return next((one for one in standing if one[2][i] <= least + 0.001), None)


def _poses(source: Source, kinematics: RobotKinematics) -> Iterator[_Pose]:
    """What the pose's readings say of the feet, the map's reading first."""
    at_s = source.at_s
    step = max(_STEP_S, float(np.diff(at_s).max(initial=0.0)))
    begins = np.linspace(at_s[0], max(at_s[-1] - step, at_s[0]), _NUM_STEPS)
    q = source.positions(np.concatenate([begins, begins + step]))
    upright = np.hstack([np.tile([1.0, *np.zeros(6)], (len(q), 1)), q[:, 7:]])
    p_BC = np.array([kinematics.contact_positions(one) for one in upright])
    R_WB = Rotation.from_quat(q[:, :4], scalar_first=True)
    for what, R, p in _readings(source.log_map.base_orientation.order, R_WB, q[:, 4:7]):
        feet = p[:, None] + np.einsum("nij,ncj->nci", R.as_matrix(), p_BC)
        first, last = np.split(feet, 2)
        lowest = np.argmin(first[..., 2] + last[..., 2], axis=1)
        moved = np.linalg.norm(last - first, axis=2)[np.arange(_NUM_STEPS), lowest]
        start = np.concatenate([R[0].as_quat(scalar_first=True), p[0], q[0, 7:]])
        slips = np.sqrt(np.mean((feet - feet.mean(axis=0)) ** 2)), np.median(moved)
        yield what, not checks.implausible(kinematics, start), (float(slips[0]), float(slips[1]))


def _readings(order: str, R: Rotation, p: np.ndarray) -> Iterator[tuple[str, Rotation, np.ndarray]]:
    """Readings of the base's orientation (N,) and position (N, 3)."""
    swapped = R.as_quat(scalar_first=order == "wxyz")
    other = Rotation.from_quat(swapped, scalar_first=order != "wxyz")
    text = f"'base_orientation.order' is {next(one for one in ORDERS if one != order)}"
    yield "", R, p
    yield text, other, p
    yield _INVERSE, R.inv(), p
    yield f"{_INVERSE}, and {text}", other.inv(), p
    yield "the whole pose is the inverse, of the world in the base", R.inv(), -R.inv().apply(p)
    quarters = [one for one in Rotation.create_group("O") if one.magnitude() > 0]
    for turn in sorted(quarters, key=lambda one: np.count_nonzero(abs(one.as_rotvec()) > 1e-6)):
        what = f"'base_orientation' is of a sensor turned on the base by {_turn_text(turn)}"
        yield what, R * turn.inv(), p
    for angle in (*range(-170, 0, 10), *range(10, 180, 10)):
        what = f"'base_orientation' is turned by {-angle}° about the vertical of the world"
        yield what, Rotation.from_euler("z", angle, degrees=True) * R, p


def check_start(source: Source, kinematics: RobotKinematics) -> None:
    """Checks that the robot stands on the ground in the first row.

    A wrong order or turn of the quaternion tilts it; wrong units lift its feet off the ground or
    move joints beyond their stops. The error suggests readings that pass the check.
    """

    def wrong(read: Source) -> str:
        return checks.implausible(kinematics, read.positions(source.at_s[:1])[0])

    if not (reason := wrong(source)):
        return
    likely = []
    for name, units in (("joint_positions", ANGLE_UNITS), ("base_position", LENGTH_UNITS)):
        part = getattr(source.log_map, name)
        for unit in units:
            log_map = replace(source.log_map, **{name: replace(part, unit=unit)})
            if unit != part.unit and not wrong(replace(source, log_map=log_map)):
                likely.append(f"'{name}.unit' is {unit}")
    if best := _stillest(_poses(source, kinematics), 1):
        likely.append(best[0])
    hint = f"; it would stand if {' or '.join(likely)}" if likely else ""
    raise ValueError(
        f"{source.where}: robot '{kinematics.robot.name}' does not stand on the ground z = 0 at "
        f"the start: {reason}{hint}"
    )
