"""Detection of a changed plant or sensor, by errors in predicting the next measured state."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from drake_safety.extras import require_extra
from drake_safety.files.progress import ignore
from drake_safety.learning.inputs import preview_names
from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo
from drake_safety.learning.state_predictor import StatePredictor

TIME_CONSTANTS_S = (0.1, 0.5, 2.0)  # Memories of the charts.
FALSE_ALARMS_PER_HOUR = 0.1  # To which the limits are extrapolated.
LEAST_MOTION_S = 360.0  # Below it limits are not learned, of the nominal plant or an actual robot.
MOST_PREDICTOR_S = 3600.0  # Longest motion for the prediction; the rest is for the limits.
LEAST_JUDGED = 0.5  # Share of inputs that can be judged, below which there is an alarm.
RECOVERED_LEVEL, RECOVERY_S = 0.7, 5.0  # Levels are below it for this time before an alarm ends.
SETTLING_S = 0.5  # Time for which the charts wait on after a disturbance that is known.
NUM_PREVIEWED = 2  # Samples of the desired preview that the predictor sees.
MOST_INNOVATION = 6.0  # In standard deviations, so that one impact is not a lasting change.
_BEFORE_LEAVING_S = 0.5  # Left out of a motion that leaves the safe set.
_BLOCK_S = 2.0  # Blocks whose maxima give the tail of a chart.
_TAIL_SHARE = 0.1  # Share of the blocks.
_NUM_FOLDS = 12  # Folds of motions; limits of the others give their levels.
_LEAST_LIMIT = 0.3  # Limit of a chart, in its standard deviations for white innovations.
_MOST_ALARMS = 0.1  # Share of safe episodes, above which the monitor does not know their motion.
_FREE_REPEATS = 3  # Beyond the longest run of repeated inputs in training.
_SETTINGS = ("alarm_level", "longest_repeat", "step_s", "motion_s")
# Arrays in which an adapted detector differs from the nominal one.
_ADAPTED = ("deviation", "limits", "settings", "predictor.linear.weight", "predictor.linear.bias")
_SIDES = {"x": ("forward", "backward"), "y": ("to the left", "to the right"), "z": ("up", "down")}


class Alarm(NamedTuple):
    """First row of an alarm, the row after its last one, and its cause."""

    begin: int
    end: int
    cause: str


@dataclass(frozen=True, kw_only=True, eq=False)
class ChangeDetector:
    """Charts of the innovation, the error of predicting the next measured state.

    Each state's innovation, in its standard deviations and clipped, has exponentially weighted
    means of itself and of its square, with three memories. The largest of the six, each in units of
    its limit, is the state's level; an alarm is a level above 1. Limits are of motion that the
    predictor has not learned, extrapolated to a rate of false alarms by exponential tails of block
    maxima (peaks over threshold; Coles 2001, section 4), of each chart and then of the levels.

    Example: ``text = assessment.detector_.describe()``
    """

    predictor: StatePredictor
    columns: np.ndarray  # Inputs among (state, desired preview, features), (n_u,).
    watched: np.ndarray  # States that it predicts, (n_w,).
    deviation: np.ndarray  # Standard deviations of the innovations, (n_w,).
    limits: np.ndarray  # Limits of the charts of the means, then of the squares, (6, n_w).
    alarm_level: float  # 1, or infinite where there was too little motion for limits.
    longest_repeat: int  # Longest known run of repeated inputs.
    step_s: float
    motion_s: float  # Motion for the limits; an actual robot's, if adapted to it.
    nominal: ChangeDetector | None = None  # Before it was adapted to an actual robot.

    def __deepcopy__(self, memo: object) -> ChangeDetector:
        return self

    @property
    def rates(self) -> np.ndarray:
        """Weight of the newest innovation in the charts of each memory, (3,)."""
        return np.minimum(1.0, self.step_s / np.array(TIME_CONSTANTS_S))

    def input_names(self, info: EpisodesInfo) -> list[str]:
        """Names of the inputs, (n_u,)."""
        every = [*info.state_names, *preview_names(info), *info.feature_names]
        return [every[i] for i in self.columns]

    def describe(self) -> str:
        """Describes the motion behind the limits, and their promise."""
        needed = f"{LEAST_MOTION_S / 60.0:.0f} are needed"
        minutes, own_minutes = (int(d.motion_s / 60.0) for d in (self.nominal or self, self))
        learned = f"monitor: {minutes} min of motion for its limits"
        promise = f"extrapolated to one false alarm in {1 / FALSE_ALARMS_PER_HOUR:.0f} h"
        if not math.isfinite(self.alarm_level):
            return f"{learned}, {needed}: it reports levels and never alarms"
        if self.nominal is None:
            return f"{learned}, {promise}"
        own = f"{learned}; {own_minutes} min of an actual robot's correct its prediction"
        if self.motion_s < LEAST_MOTION_S:
            return f"{own}, {needed} to widen limits: no rate of false alarms is promised on it"
        return f"{own} and widen limits, {promise}"

    @classmethod
    def fit(
        cls,
        motions: Episodes,
        progress: Callable[[float], object] = ignore,
        *,
        episodes: Episodes | None = None,
    ) -> ChangeDetector:
        """Learns a prediction from half of the motions, at most an hour; limits from the rest.

        Args:
            progress: Called with the share done.
            episodes: Further, disturbed motion; only safe episodes are used.
        """
        require_extra("train", "ChangeDetector.fit", "torch")
        info = motions.info
        watched = _chosen(info.monitored_states, info.state_names, "monitored_states")
        features = _chosen(info.monitored_features, info.feature_names, "monitored_features")
        num_states, num_outputs = len(info.state_names), len(info.output_names)
        plan = num_states + np.arange(min(NUM_PREVIEWED, info.horizon) * num_outputs)
        features += num_states + info.horizon * num_outputs
        columns = np.concatenate([watched, plan, features])
        for what in ("state_names", "output_names", "feature_names", "horizon", "step_s"):
            other, expected = getattr((episodes or motions).info, what), getattr(info, what)
            if other != expected:
                raise ValueError(
                    f"ChangeDetector: motions and episodes differ in {what}: {expected} and {other}"
                )
        every = [*usual_rows(motions), *_safe_rows(episodes or [])]
        inputs, states = _split_rows(every, columns, watched)
        if len(inputs) < 2:
            raise ValueError(f"ChangeDetector: {len(inputs)} motions have three rows, not two")
        with threadpool_limits(1, user_api="blas"):
            # Motions alternate, so that both parts are alike.
            stride = max(2, math.ceil(info.step_s * sum(map(len, inputs)) / MOST_PREDICTOR_S))
            of_limits = [i for i in range(len(inputs)) if i % stride]
            predictor = StatePredictor.fit(inputs[::stride], states[::stride], progress)
            unlimited = cls(
                predictor=predictor,
                columns=columns,
                watched=watched,
                deviation=np.full(len(watched), 1e-9),
                limits=np.ones((2 * len(TIME_CONSTANTS_S), len(watched))),
                alarm_level=math.inf,
                longest_repeat=_free_repeats(inputs),
                step_s=float(info.step_s),
                motion_s=0.0,
            )
            return unlimited._limited(
                [inputs[i] for i in of_limits], [states[i] for i in of_limits]
            )

    def describe_alarms(self, episodes: Episodes) -> tuple[str, bool]:
        """Says how many safe episodes have an alarm, and whether these are few."""
        safe = _safe_rows(episodes)
        alarms = sum(bool(self.watch([rows])[1]) for rows in safe)
        text = f"monitor: alarms in {alarms} of {len(safe)} safe episodes"
        if alarms > _MOST_ALARMS * len(safe):
            return f"{text}: train with more, or choose on_alarm: report", False
        return text, True

    def _limited(
        self, inputs: Sequence[np.ndarray], states: Sequence[np.ndarray]
    ) -> ChangeDetector:
        """Chooses deviations and limits from inputs (K, n_u) and states (K, n_w) of motions."""
        errors = [self.predictor.errors(*motion) for motion in zip(inputs, states, strict=True)]
        if len(errors) == 1 and len(errors[0]) > 1:
            errors = np.array_split(errors[0], 2)
        deviation = np.maximum(np.concatenate(errors).std(axis=0), self.deviation)
        charts = [_sizes(self._charts(e / deviation)) for e in errors]
        blocks = [_block_maxima(chart, self.step_s) for chart in charts]
        motion_s = self.step_s * sum(map(len, errors))
        least = _LEAST_LIMIT * np.sqrt(self.rates / (2.0 - self.rates))
        least = np.concatenate([least, math.sqrt(2.0) * least])[:, None]
        probability = FALSE_ALARMS_PER_HOUR * _BLOCK_S / 3600.0

        def tails(known: Sequence[np.ndarray]) -> np.ndarray:
            threshold, excess = _exponential_tail(np.concatenate(known))
            return np.maximum(threshold + excess * math.log(_TAIL_SHARE / probability), least)

        # Each fold in units of the others: the limits must hold for motion that they do not know.
        folds = [blocks[i::_NUM_FOLDS] for i in range(min(_NUM_FOLDS, len(blocks)))]
        levels = []
        for i, fold in enumerate(folds):
            others = [block for other in folds[:i] + folds[i + 1 :] for block in other]
            levels.append((np.concatenate(fold) / tails(others or fold)).max(axis=(1, 2)))
        limits = _tail_limit(np.concatenate(levels), probability) * tails(blocks)
        alarm_level = 1.0 if motion_s >= LEAST_MOTION_S else math.inf
        changed = {"deviation": deviation, "limits": limits, "alarm_level": alarm_level}
        return replace(self, motion_s=motion_s, **changed)

    def _charts(self, innovations: np.ndarray) -> np.ndarray:
        """The charts, signed, after each of consecutive innovations (K, n_w), (K, 6, n_w)."""
        innovations = np.clip(innovations, -MOST_INNOVATION, MOST_INNOVATION)
        both = innovations, np.square(innovations) - 1.0
        return np.stack([_smoothed(v, rate) for v in both for rate in self.rates], axis=1)

    def innovation(self, x: np.ndarray, previous: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The innovation (n_w,) of a change of the state after two inputs (n_u,), clipped."""
        error = self.predictor.error(x, previous, change)
        return np.minimum(np.maximum(error / self.deviation, -MOST_INNOVATION), MOST_INNOVATION)

    def updated(self, charts: np.ndarray, innovation: np.ndarray) -> np.ndarray:
        """The charts (6, n_w), signed, after one more innovation (n_w,)."""
        values = np.array((innovation, innovation * innovation - 1.0))
        old = charts.reshape(2, len(TIME_CONSTANTS_S), -1)
        return (old + self.rates[:, None] * (values[:, None] - old)).reshape(charts.shape)

    def levels(
        self,
        charts: np.ndarray,
        repeats: float | np.ndarray = 0.0,
        judged: float | np.ndarray = 1.0,
    ) -> np.ndarray:
        """Largest chart (..., 6, n_w) of each state, in units of its limit, (..., n_w).

        The length of the run of repeated inputs and the share of inputs that could be judged,
        (..., 1), concern all states.
        """
        levels = (_sizes(charts) / self.limits).max(axis=-2)
        blind = (1.0 - judged) / (1.0 - LEAST_JUDGED)
        return np.maximum(levels, np.maximum(repeats / self.longest_repeat, blind))

    def watch(
        self, motions: Sequence[np.ndarray], state_names: Sequence[str] | None = None
    ) -> tuple[np.ndarray, list[Alarm]]:
        """Levels at each row of consecutive motions (K, n), (sum of K, n_w), and the alarms.

        Between motions the charts keep their values. A row that is not finite, and the two after
        it, are not judged.
        """
        errors, repeats = [np.zeros((0, len(self.watched)))], [np.zeros(1)]  # First, of no row.
        lost, judged = [], []
        for rows in motions:
            x, states, row = rows[:, self.columns], rows[:, self.watched], np.arange(len(rows))
            is_gap = ~np.isfinite(x).all(axis=1)
            last_gap = np.maximum.accumulate(np.where(is_gap, row, -3))
            lost.append(row - last_gap < 3)
            judged.append((row > 1) & ~lost[-1])
            if judged[-1].any():
                every = self.predictor.errors(np.where(is_gap[:, None], 0.0, x), states)
                errors.append(every[judged[-1][2:]])
                repeats.append(_repeats(x)[1:][judged[-1][2:]])
        is_lost, is_judged = np.concatenate(lost), np.concatenate(judged)
        charts = self._charts(np.concatenate(errors) / self.deviation)
        charts, runs = np.insert(charts, 0, 0.0, axis=0), np.concatenate(repeats)
        newest = np.cumsum(is_judged)
        share = 1.0 - _smoothed(is_lost.astype(float), self.rates[-1])
        levels = self.levels(charts[newest], runs[newest, None], share[:, None])
        places = [*np.flatnonzero(is_judged | is_lost).tolist(), len(levels)]
        states_of_alarm = [(0.0, 0.0)]
        for level in levels[places[:-1]].max(axis=1):
            states_of_alarm.append(self.next_alarm(*states_of_alarm[-1], level))
        changes = np.flatnonzero(np.diff([on for on, _ in states_of_alarm], append=0.0)).tolist()
        names, alarms = state_names or [""] * len(self.watched), []
        for begin, end in zip(changes[::2], changes[1::2], strict=True):
            first, last = places[begin], newest[places[begin]]
            cause = self.cause(charts[last], runs[last], names, float(share[first]))
            alarms.append(Alarm(first, places[end], cause))
        return levels, alarms

    def next_alarm(self, alarm: float, below_s: float, level: float) -> tuple[float, float]:
        """Alarm (0 or 1), and time for which all levels have been low [s], after one more level."""
        if not level <= self.alarm_level:  # Also for NaN.
            return 1.0, 0.0
        below_s = below_s + self.step_s if level < RECOVERED_LEVEL else 0.0
        if alarm == 0.0 or below_s > RECOVERY_S - 0.5 * self.step_s:
            return 0.0, 0.0
        return 1.0, below_s

    def with_motions(self, motions: Sequence[np.ndarray]) -> ChangeDetector:
        """Returns the nominal detector for which an actual robot's motions (K, n) are known too.

        The prediction gets a linear correction. With `LEAST_MOTION_S` of motion limits widen to it.
        """
        nominal = self.nominal or self
        inputs, states = _split_rows(motions, self.columns, self.watched)
        if not inputs:
            return nominal
        predictor = nominal.predictor.corrected(inputs, states)
        corrected = replace(nominal, predictor=predictor, nominal=nominal)
        limited = corrected._limited(inputs, states)
        if limited.motion_s < LEAST_MOTION_S:
            return replace(corrected, motion_s=limited.motion_s)
        return replace(
            limited,
            alarm_level=nominal.alarm_level,
            limits=np.maximum(limited.limits, nominal.limits),
            longest_repeat=max(nominal.longest_repeat, _free_repeats(inputs)),
        )

    def cause(
        self, charts: np.ndarray, repeats: float, state_names: Sequence[str], judged: float = 1.0
    ) -> str:
        """Says in which watched state charts (6, n_w) show an alarm, and of what kind it is."""
        if judged < LEAST_JUDGED:
            return "blind: most inputs are not finite, or follow one that is not"
        if repeats > self.longest_repeat:
            return "inputs frozen"
        ratio = _sizes(charts) / self.limits
        chart, state = map(int, np.unravel_index(np.argmax(ratio), ratio.shape))
        memory_s = 2.0 * TIME_CONSTANTS_S[chart % len(TIME_CONSTANTS_S)]
        name, value = state_names[state], float(charts[chart, state])
        is_mean = chart < len(TIME_CONSTANTS_S)
        joint = name.removesuffix("_rate")
        if joint in state_names and f"{joint}_rate" in state_names:
            what = f"joint {joint} answers unlike in training"
        elif is_mean and name.startswith(("velocity_", "base_")) and name[-1] in _SIDES:
            what = f"pushed steadily {_SIDES[name[-1]][int(value < 0.0)]}"
        else:
            what = f"{name} changes unlike in training"
        size = f"{value:+.1f} standard deviations"
        if not is_mean:
            size = f"{math.sqrt(value + 1.0):.1f} times as irregular"
        return f"{what} ({name} {size} over {memory_s:g} s)"

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all that `from_arrays` needs, by name."""
        own = {
            "deviation": self.deviation,
            "limits": self.limits,
            "columns": self.columns.astype(np.int32),
            "watched": self.watched.astype(np.int32),
            "settings": np.array([getattr(self, name) for name in _SETTINGS], dtype=float),
            **{f"predictor.{k}": v for k, v in self.predictor.arrays().items()},
        }
        nominal = {} if self.nominal is None else self.nominal.arrays()
        return own | {f"nominal.{k}": nominal[k] for k in _ADAPTED if nominal}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> ChangeDetector:
        """Makes the detector of arrays written by `arrays`."""
        settings: dict[str, Any] = dict(zip(_SETTINGS, arrays["settings"].tolist(), strict=True))
        own = {k: v for k, v in arrays.items() if not k.startswith("nominal.")}
        adapted = {k.removeprefix("nominal."): v for k, v in arrays.items() if k not in own}
        nominal = cls.from_arrays(own | adapted) if adapted else None
        predictor = {k.removeprefix("predictor."): v for k, v in own.items() if "predictor." in k}
        return cls(
            nominal=nominal,
            predictor=StatePredictor.from_arrays(predictor),
            columns=arrays["columns"].astype(int),
            watched=arrays["watched"].astype(int),
            deviation=arrays["deviation"].astype(float),
            limits=arrays["limits"].astype(float),
            **settings,
        )


def _chosen(names: Sequence[str] | None, every: Sequence[str], what: str) -> np.ndarray:
    """Places of names among all of them; all places for None."""
    names = every if names is None else names
    if unknown := [name for name in names if name not in every]:
        raise ValueError(f"ChangeDetector: {what} has {unknown}, which are none of {list(every)}")
    return np.array([every.index(name) for name in names], dtype=int)


def rows_of(motion: Episode) -> np.ndarray:
    """(state, desired preview, features) of a motion, (K, n)."""
    return np.concatenate([motion.state, motion.desired_preview, motion.features], axis=1)


def usual_rows(motions: Episodes) -> list[np.ndarray]:
    """(state, desired preview, features) of motions (K, n), until shortly before they leave."""
    lost = math.ceil(_BEFORE_LEAVING_S / motions.info.step_s)
    return [rows_of(m)[m.first_step : None if m.is_safe else -lost] for m in motions]


def _smoothed(values: np.ndarray, rate: float) -> np.ndarray:
    """Exponentially weighted means of values (K, ...) until each, from zero on."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([rate], [1.0, rate - 1.0], values, axis=0))


def _safe_rows(episodes: Iterable[Episode]) -> list[np.ndarray]:
    """Rows of safe episodes (K, n) whose future is undisturbed."""
    return [rows_of(episode)[episode.first_step :] for episode in episodes if episode.is_safe]


def _split_rows(
    motions: Iterable[np.ndarray], columns: np.ndarray, watched: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Inputs (K, n_u) and states (K, n_w) of motions of at least three rows."""
    rows = [motion for motion in motions if len(motion) > 2]
    return [motion[:, columns] for motion in rows], [motion[:, watched] for motion in rows]


def _sizes(charts: np.ndarray) -> np.ndarray:
    """Charts (..., 6, n_w) with the absolute values of the means."""
    means, squares = np.split(charts, 2, axis=-2)
    return np.concatenate([np.abs(means), squares], axis=-2)


def _block_maxima(charts: np.ndarray, step_s: float) -> np.ndarray:
    """Maxima of blocks of two seconds of charts (K, 6, n_w), (B, 6, n_w)."""
    size = max(1, round(_BLOCK_S / step_s))
    starts = range(0, max(len(charts) - size // 2, 1), size)
    return np.stack([charts[i : i + size].max(axis=0) for i in starts])


def _exponential_tail(maxima: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds exceeded by a share of the blocks (B, ...), and the mean excesses, (...)."""
    threshold = np.quantile(maxima, 1.0 - _TAIL_SHARE, axis=0)
    excess = np.maximum(maxima - threshold, 0.0)
    return threshold, excess.sum(axis=0) / np.maximum((excess > 0.0).sum(axis=0), 1)


def _tail_limit(levels: np.ndarray, probability: float) -> float:
    """The level that a block exceeds with a small probability, by an exponential tail.

    The mean excess is its upper bound of 95 %: the less motion, the wider the limit.
    """
    from scipy.stats import chi2

    threshold, excess = _exponential_tail(levels)
    num = int((levels > threshold).sum())
    if not num:
        return 2.0 * float(levels.max())
    bound = excess * 2.0 * num / chi2.ppf(0.05, 2 * num)
    limit = threshold + bound * math.log(_TAIL_SHARE / probability)
    return float(max(limit, levels.max()))


def _repeats(x: np.ndarray) -> np.ndarray:
    """Length of the run of repeated inputs, from the second input on, (K - 1,)."""
    row, is_same = np.arange(1, len(x)), np.all(x[1:] == x[:-1], axis=1)
    last_new = np.maximum.accumulate(np.where(is_same, 0, row))
    return (row - last_new).astype(float)


def _free_repeats(inputs: Sequence[np.ndarray]) -> int:
    """Length of a run of repeated inputs below an alarm, after motions (K, n_u)."""
    return int(max(_repeats(x).max(initial=0.0) for x in inputs)) + _FREE_REPEATS
