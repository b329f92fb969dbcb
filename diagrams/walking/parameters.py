"""Parameters of the walking task: commands, starts, guard and recovery."""

import math
from dataclasses import field
from typing import ClassVar, Literal

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.diagrams.walking.safe_set import WalkingLimits
from drake_safety.files.schema import Bounds, Count, NotNegative, Positive, Share, Triple, schema
from drake_safety.plants.pushes import Push, RandomPushes
from drake_safety.policies.policy import CommandLimits
from drake_safety.simulation.legged_loop import View

_RAMP_S = 0.1  # From one command to the next.


@schema(kw_only=True)
class CommandSampling:
    """Random velocity profiles."""

    reach: Positive = 3.0  # Factor on the policy's ranges, beyond which commands go.
    inside_share: Share = 0.3  # Share of profiles inside the policy's ranges.
    num_segments: Bounds[Count] = field(default_factory=lambda: [1, 3])  # Constant commands.
    standing_share: Share = 0.1

    def sample_command(
        self, limits: CommandLimits, rng: np.random.Generator, reach: float = 1.0
    ) -> np.ndarray:
        """Samples a command, (3,) [m/s, rad/s]."""
        low, high = reach * np.array(limits.lowest), reach * np.array(limits.highest)
        drawn = rng.uniform(low, high)
        return np.zeros(3) if rng.random() < self.standing_share else drawn

    def sample(
        self, limits: CommandLimits, rng: np.random.Generator, duration_s: float
    ) -> PiecewisePolynomial:
        """Samples a profile of constant commands with short ramps between them."""
        reach = 1.0 if rng.random() < self.inside_share else self.reach
        count = int(rng.integers(self.num_segments[0], self.num_segments[1] + 1))
        commands = [self.sample_command(limits, rng, reach) for _ in range(count)]
        changes = np.sort(rng.uniform(0.1 * duration_s, 0.9 * duration_s, count - 1))
        return profile(commands, changes.tolist(), duration_s)


def profile(
    commands: list[np.ndarray], changes_s: list[float], duration_s: float
) -> PiecewisePolynomial:
    """A profile of constant commands (3,) [m/s, rad/s] that change at ascending times."""
    times, values = [0.0], [commands[0]]
    for change_s, before, after in zip(changes_s, commands[:-1], commands[1:], strict=True):
        begins = max(change_s, times[-1] + 1e-3)
        times += [begins, begins + _RAMP_S]
        values += [before, after]
    times.append(max(duration_s, times[-1] + 1e-3))
    values.append(values[-1])
    return PiecewisePolynomial.FirstOrderHold(times, np.transpose(values))


@schema(kw_only=True)
class WalkingStart:
    """Random initial states: standing or in mid-stride, some with an offset as after a push."""

    standing_share: Share = 0.25  # Share of episodes that begin at rest in the standing posture.
    # Time since the robot stood, in the other episodes.
    walked_s: Bounds[NotNegative] = field(default_factory=lambda: [0.2, 1.6])
    push_share: Share = 0.5  # Share of episodes with an offset.
    velocity_m_s: float = 2.0  # Largest horizontal velocity offset of the base.
    angular_velocity_rad_s: float = 1.5  # Half-width of the base's offset, per axis.
    tilt_rad: float = 0.15
    joint_rad: float = 0.05  # Standard deviation of the joints' offsets.

    def offset_velocities(self, v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Adds a sampled offset to velocities, of the base in the world and angular first."""
        v = v.copy()
        speed, direction = rng.uniform(0, self.velocity_m_s), rng.uniform(-math.pi, math.pi)
        v[:3] += rng.uniform(-1, 1, 3) * self.angular_velocity_rad_s
        v[3:5] += speed * np.array([math.cos(direction), math.sin(direction)])
        return v

    def offset_positions(self, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Adds a sampled offset of tilt and joints to positions."""
        q = q.copy()
        a, b = 0.5 * rng.uniform(-1, 1, 2) * self.tilt_rad
        w, x, y, z = q[:4]
        # A small rotation about the base's x and y axes.
        turned = np.array(
            [w - x * a - y * b, x + w * a - z * b, y + w * b + z * a, z + x * b - y * a]
        )
        q[:4] = turned / np.linalg.norm(turned)
        q[7:] += rng.normal(size=len(q) - 7) * self.joint_rad
        return q


@schema(kw_only=True)
class GuardParameters:
    """The command guard."""

    threshold: Share = 0.9  # Lowest probability of a command that is passed on.
    period_s: Positive = 0.1


@schema(kw_only=True)
class WalkingRecovery:
    """Reaction of the robot when the probability falls below a threshold."""

    branch: Literal["stop", "slower"] = "stop"  # A command of zero, or a share of the command.
    threshold: float = 0.5  # Γ_thre, of the probability; not tuned.
    # Time for which "don't know" lasts before a trigger: one row of a start can be unlike training.
    persistence_s: NotNegative = 0.04
    slower_share: float = 0.3


@schema(kw_only=True)
class WalkingParameters:
    """The task's part of the scenario file."""

    online: ClassVar = (
        "guard",
        "recovery",
        "named_commands",
        "pushes",
        "random_pushes",
        "assessment_period_s",
        "view",
    )

    policy: str = "policy.yaml"
    """Policy file, relative to the folder of the robot's YAML file; or a network that replaces the
    network of ``policy.yaml`` there."""
    safe_set: WalkingLimits = field(default_factory=WalkingLimits)
    commands: CommandSampling = field(default_factory=CommandSampling)
    start: WalkingStart = field(default_factory=WalkingStart)
    named_commands: dict[str, Triple] = field(default_factory=dict)  # (v_x, v_y, ω_z).
    pushes: dict[str, Push] = field(default_factory=dict)
    random_pushes: RandomPushes = field(default_factory=RandomPushes)  # To judge alarms by.
    view: View = field(default_factory=View)
    guard: GuardParameters = field(default_factory=GuardParameters)
    recovery: WalkingRecovery = field(default_factory=WalkingRecovery)
    assessment_period_s: Positive = 0.02
