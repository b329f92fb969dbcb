"""Episodes of a closed loop, their unsafety scores, and their split into segments."""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, overload

import numpy as np

from drake_safety.learning.assessment_parameters import MOST_SAMPLES, AssessmentParameters
from drake_safety.learning.mode_settings import mode_settings

# Arrays that an episode holds per row, besides its time.
RECORDED = (
    *("state", "true_state", "output", "desired_output"),
    *("desired_preview", "features", "margins"),
)
LARGEST = 1e12  # Any quantity in SI units is smaller, but for errors of a log and divergences.
DIVERGED = "diverged"  # Cause of an episode whose simulation failed; it has no safety label.
_LOGGER = logging.getLogger("drake_safety")
_FEW = 1.0  # Percentage of starts outside the safe set without a warning.


class DivergenceError(RuntimeError):
    """A simulation that diverged."""


class EpisodeError(RuntimeError):
    """An error during a motion: of a system, or a divergence that may not be a result."""


def installed_versions(*packages: str) -> dict[str, str]:
    """Versions of this package and of others, as far as installed, by name."""
    versions = {"drake_safety": "0+uninstalled"}
    for name in ("drake_safety", *packages):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


@dataclass(kw_only=True)
class EpisodesInfo:
    """Metadata that all episodes of a set share."""

    scenario: str
    scenario_hash: str  # SHA-256 of everything that determines a rollout, robot files included.
    variation: str  # The simulated plant, such as "nominal" or "actual".
    seed: int
    step_s: float  # Time between two rows of an episode.
    horizon: int  # H, samples of the preview.
    constraint_names: list[str]  # The n_c columns of `margins`, and possible causes.
    state_names: list[str]
    output_names: list[str]
    feature_names: list[str]
    versions: dict[str, str]
    num_steps: int = 0  # T, rows after the first one of a complete episode; 0 if unknown.
    preview_stride: int = 1  # Rows between two of the H samples of a preview or a segment.
    monitored_states: list[str] | None = None  # That a `ChangeDetector` predicts; None for all.
    monitored_features: list[str] | None = None  # By which it predicts them; None for all.
    robot: str = ""
    until: str = ""  # The only constraint whose violation ends an episode; empty for every one.
    plants: int = 0  # Size of the family whose plants the episodes have in turn; 0 for one plant.

    def __post_init__(self) -> None:
        is_known = 1 <= self.horizon <= MOST_SAMPLES and self.preview_stride >= 1
        if not (is_known and self.step_s > 0.0):
            numbers = f"horizon {self.horizon}, preview_stride {self.preview_stride} and step_s"
            raise ValueError(f"episodes of '{self.scenario}' cannot have {numbers} {self.step_s}")

    @property
    def preview_step_s(self) -> float:
        """Time between two samples of a preview, the paper's step [s]."""
        return self.preview_stride * self.step_s

    def plant_of(self, index: int) -> int:
        """Number of the plant of an episode, from 1 on; 0 without a family."""
        return 1 + index % self.plants if self.plants else 0

    @property
    def columns(self) -> dict[str, list[str]]:
        """Names of the columns of each recorded array."""
        preview = [f"{name}[{k}]" for k in range(self.horizon) for name in self.output_names]
        return {
            "state": self.state_names,
            "true_state": self.state_names,
            "output": self.output_names,
            "desired_output": self.output_names,
            "desired_preview": preview,
            "features": self.feature_names,
            "margins": self.constraint_names,
        }

    @property
    def widths(self) -> dict[str, int]:
        """Number of columns of each recorded array by name."""
        return {name: len(names) for name, names in self.columns.items()}


def floats(values: Any) -> np.ndarray:
    """Numbers as an array of floats, NaN where they are masked."""
    if type(values) is not np.ndarray:
        values = np.ma.asarray(values, dtype=float).filled(np.nan)
    return np.asarray(values, dtype=float)


@dataclass(kw_only=True, eq=False)
class Episode:
    """One closed-loop rollout, sampled at rows 0..K; row r is at time r * step_s.

    The last row is the sample at t = T or at the instant when the safe set was left.

    Example: ``last_margins = episodes[0].margins[-1]``
    """

    index: int
    time_s: np.ndarray  # (K+1,)
    state: np.ndarray  # Measured, with noise, (K+1, n_s).
    true_state: np.ndarray  # Without noise, (K+1, n_s).
    output: np.ndarray  # Measured output z [m], (K+1, n_z).
    desired_output: np.ndarray  # Desired output z* [m], (K+1, n_z).
    desired_preview: np.ndarray  # The next H desired outputs, row-major in time, (K+1, H*n_z).
    features: np.ndarray  # Measured, (K+1, n_f).
    margins: np.ndarray  # Distance to each constraint, negative where violated, (K+1, n_c).
    is_safe: bool  # Whether the whole rollout stayed in the safe set.
    cause: str  # "" when safe, else the name of the violated constraint, or "diverged".
    first_step: int = 0  # First row with an undisturbed future; earlier rows are not learned.
    num_controller_failures: int = 0
    plant: int = 0  # Number of the plant in its family; 0 for the only plant of a set.

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ma.MaskedArray):
                setattr(self, name, floats(value))

    @property
    def num_steps(self) -> int:
        """K, the number of steps from the first row to the last."""
        return len(self.time_s) - 1

    @property
    def first_inputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Γ's inputs in the first undisturbed row: (n_s,), (H*n_z,) and (n_f,)."""
        row = self.first_step
        return self.state[row], self.desired_preview[row], self.features[row]


class Episodes(Sequence[Episode]):
    """A set of episodes that share one `EpisodesInfo` and fit it; a slice is a set.

    Example: ``unsafe = [episode.cause for episode in episodes[:8] if not episode.is_safe]``
    """

    def __init__(self, info: EpisodesInfo, episodes: Iterable[Episode]):
        self.info = info
        self._is_warned = False
        self._episodes = list(episodes)
        for episode in self._episodes:
            _check_episode(info, episode)

    def __len__(self) -> int:
        return len(self._episodes)

    def __repr__(self) -> str:
        return (
            f"Episodes('{self.info.scenario}', variation '{self.info.variation}', seed "
            f"{self.info.seed}, {len(self)} episodes: {self.num_safe} safe, {self.num_unsafe} "
            f"unsafe, {self.num_diverged} diverged)"
        )

    @overload
    def __getitem__(self, key: int) -> Episode: ...
    @overload
    def __getitem__(self, key: slice) -> Episodes: ...
    def __getitem__(self, key: int | slice) -> Episode | Episodes:
        if isinstance(key, slice):
            return Episodes(self.info, self._episodes[key])
        return self._episodes[key]

    def joined(self, other: Episodes) -> Episodes:
        """This set followed by episodes of other plants with the same columns and steps."""
        names = ("columns", "step_s", "horizon", "preview_stride")
        if wrong := [n for n in names if getattr(self.info, n) != getattr(other.info, n)]:
            sets = f"'{self.info.scenario}' and '{other.info.scenario}'"
            raise ValueError(f"Episodes.joined: the sets of {sets} differ in {wrong}")
        return Episodes(self.info, [*self, *other])

    @property
    def num_safe(self) -> int:
        """Number of safe episodes."""
        return sum(episode.is_safe for episode in self._episodes)

    @property
    def num_diverged(self) -> int:
        """Number of episodes whose simulation failed."""
        return sum(episode.cause == DIVERGED for episode in self._episodes)

    @property
    def num_unsafe(self) -> int:
        """Number of episodes that left the safe set."""
        return len(self) - self.num_safe - self.num_diverged

    def warn(self) -> None:
        """Logs, once, why little can be learned from these episodes, if so."""
        known = [] if self._is_warned else [e for e in self if e.cause != DIVERGED]
        self._is_warned, who = True, self.info.scenario
        for k, name in enumerate(self.info.constraint_names if known else ()):
            first = [e.margins[0, k] < 0.0 or (e.cause == name and not e.num_steps) for e in known]
            if (share := 100.0 * np.mean(first)) > _FEW:
                _LOGGER.warning(
                    "%.0f %% of the starts of '%s' violate '%s' in their first row, of which "
                    "nothing is learned; draw starts inside the safe set",
                    *(share, who, name),
                )
        labels = {e.is_safe for e in known if e.num_steps > e.first_step}
        if known and len(labels) < 2:
            what, starts = ("safe", "calmer") if True not in labels else ("unsafe", "wider")
            text = "none of %d episodes of '%s' is %s after its first row, so that Γ learns no "
            _LOGGER.warning(text + "difference; draw %s starts", len(known), who, what, starts)


def _check_episode(info: EpisodesInfo, episode: Episode) -> None:
    who, num_rows = f"episode {episode.index} of '{info.scenario}'", len(episode.time_s)
    for name, width in info.widths.items():
        shape = np.shape(getattr(episode, name))
        if shape != (num_rows, width):
            raise ValueError(f"{who}: {name} has shape {shape}, expected {(num_rows, width)}")
    if not 0 <= episode.first_step < num_rows:
        raise ValueError(f"{who}: first_step is {episode.first_step} of {num_rows} rows")
    causes = [""] if episode.is_safe else [DIVERGED, *info.constraint_names]
    if episode.cause not in causes:
        raise ValueError(f"{who}: the cause '{episode.cause}' is none of {causes}")


def unsafety_score(
    remaining_steps: np.ndarray, is_unsafe: np.ndarray, discount: float
) -> np.ndarray:
    """Returns lambda = gamma^R if a trajectory is unsafe, else 0, (N,); R are the steps left."""
    return np.where(is_unsafe, float(discount) ** np.asarray(remaining_steps, dtype=float), 0.0)


@dataclass(kw_only=True, eq=False)
class Segments:
    """N segments of episodes, each at most H samples long, as training data of an assessment.

    State, preview and features belong to the row at which a segment starts.
    """

    episode: np.ndarray  # Position of the episode in its set.
    group: np.ndarray  # That of the episode, or -k for plant k of a family: held out as a whole.
    start_row: np.ndarray
    is_first: np.ndarray  # Whether the segment starts at its episode's `first_step`.
    remaining_steps: np.ndarray  # Rows until the episode ends.
    is_unsafe: np.ndarray
    score: np.ndarray  # Unsafety score lambda.
    cause: np.ndarray  # Column of the constraint that ended the episode, -1 when safe.
    state: np.ndarray
    true_state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    future_margins: np.ndarray  # Smallest from the start to the episode's end, (N, n_c).
    error: np.ndarray  # Tracking errors z* - z [m], the last one repeated, (N, H, n_z).
    length: np.ndarray  # Recorded samples of `error`: H, or less at an episode's end.

    def __len__(self) -> int:
        return len(self.score)

    def take(self, rows: np.ndarray) -> Segments:
        """Selects segments by a mask or by indices, (M,)."""
        return replace(self, **{name: values[rows] for name, values in vars(self).items()})


_Segments = TypeVar("_Segments", bound=Segments)


def joined(parts: Sequence[_Segments]) -> _Segments:
    """Joins segments of one class into one object."""
    names = vars(parts[0])
    return replace(
        parts[0], **{name: np.concatenate([vars(part)[name] for part in parts]) for name in names}
    )


def split(
    episodes: Episodes, *, stride: int, discount: float, shortest: int | None = None
) -> Segments:
    """Splits episodes into segments of H samples, ``preview_stride`` rows apart.

    Segments start where at least ``shortest`` samples of a complete episode are left, for both
    labels, so that a start row carries no information about the label; H by default. Segments that
    reach beyond the end are cut short and keep the terminal sample. Diverged episodes are skipped.
    `stride` is the number of rows between two starts.
    """
    horizon, sample = episodes.info.horizon, episodes.info.preview_stride
    shortest = horizon if shortest is None else shortest
    if not (1 <= shortest <= horizon and stride >= 1):
        raise ValueError(
            f"split: shortest is {shortest}, stride {stride}; expected 1..{horizon}, >= 1"
        )
    offsets, names = sample * np.arange(horizon), episodes.info.constraint_names
    parts = []
    # If T is unknown, the longest episode is taken as complete.
    whole = episodes.info.num_steps or max((e.num_steps for e in episodes), default=0)
    for position, episode in enumerate(episodes):
        if episode.cause == DIVERGED:
            continue
        num_steps = episode.num_steps
        # A safe episode may be shorter than T, as a part of a robot's log is.
        end = min(num_steps, (num_steps if episode.is_safe else whole) - sample * shortest + 1)
        rows = np.arange(episode.first_step, end, stride)
        if rows.size == 0:
            continue
        remaining = num_steps - rows
        is_unsafe = np.full(rows.size, not episode.is_safe)
        error = episode.desired_output - episode.output
        part = Segments(
            episode=np.full(rows.size, position),
            group=np.full(rows.size, -episode.plant or position),
            start_row=rows,
            is_first=rows == episode.first_step,
            remaining_steps=remaining,
            is_unsafe=is_unsafe,
            score=unsafety_score(remaining / sample, is_unsafe, discount),
            cause=np.full(rows.size, -1 if episode.is_safe else names.index(episode.cause)),
            state=episode.state[rows],
            true_state=episode.true_state[rows],
            desired_preview=episode.desired_preview[rows],
            features=episode.features[rows],
            future_margins=np.minimum.accumulate(episode.margins[::-1], axis=0)[::-1][rows],
            error=error[np.minimum(rows[:, None] + offsets, num_steps)],
            length=np.minimum(horizon, remaining // sample + 1),
        )
        parts.append(part)
    if not parts:
        raise ValueError(
            f"split: none of the {len(episodes)} episodes of '{episodes.info.scenario}' gives "
            f"a segment of {shortest} samples ({episodes.num_diverged} diverged)"
        )
    return joined(parts)


def training_segments(episodes: Episodes, parameters: AssessmentParameters) -> Segments:
    """Splits training episodes into segments according to the mode."""
    for name in ("horizon", "preview_stride"):
        here, there = getattr(parameters, name), getattr(episodes.info, name)
        if here != there:
            who = f"the episodes of '{episodes.info.scenario}'"
            raise ValueError(f"SafetyAssessment: {name} is {here}, that of {who} is {there}")
    settings = mode_settings(parameters)
    return split(
        episodes, stride=settings.stride, discount=parameters.discount, shortest=settings.shortest
    )
