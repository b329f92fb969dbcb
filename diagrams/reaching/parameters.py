"""Parameters of the reaching task."""

from dataclasses import field
from typing import ClassVar

from drake_safety.diagrams.reaching.safe_set import ReachingLimits
from drake_safety.diagrams.reaching.sampling import Detours, PostureSampling, TargetSampling
from drake_safety.files.schema import Positive, Triple, schema
from drake_safety.plants.obstacles import Obstacle
from drake_safety.plants.pushes import Push, RandomPushes
from drake_safety.simulation.legged_loop import View


@schema(kw_only=True)
class ReachingParameters:
    """The task's part of the scenario file."""

    online: ClassVar = ("decorations", "named_targets", "pushes", "assessment_period_s", "view")

    hand: str = ""  # Hand of the training episodes; by default the robot's first reaching frame.
    plan_duration_s: Positive = 3.0
    monitor_period_s: Positive = 0.02
    clearance_range_m: Positive = 0.1  # Distances to obstacles are clipped to this.
    safe_set: ReachingLimits = field(default_factory=ReachingLimits)
    start: PostureSampling = field(default_factory=PostureSampling)
    target: TargetSampling = field(default_factory=TargetSampling)
    random_pushes: RandomPushes = field(default_factory=RandomPushes)
    detours: Detours = field(default_factory=Detours)
    obstacles: list[Obstacle] = field(default_factory=list)
    decorations: list[Obstacle] = field(default_factory=list)  # For pictures alone.
    named_targets: dict[str, Triple] = field(default_factory=dict)
    pushes: dict[str, Push] = field(default_factory=dict)
    assessment_period_s: Positive = 0.1  # The features of a plan cost some 4 ms.
    view: View = field(default_factory=View)
