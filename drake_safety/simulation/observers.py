"""Observers of one robot in a diagram: as many as there are strengths of noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import RandomSource

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.robots.robot import ObservationNoise
from drake_safety.systems.state_observer import StateObserver


class Observers:
    """Adds observers to a diagram, each with a source of its noise.

    Args:
        builder: The diagram's builder.
        kinematics: The robot.
        plant_state: Port of its true state.
        period_s: Time between two draws of noise [s].
        **options: Of every `StateObserver`.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        kinematics: RobotKinematics,
        plant_state: OutputPort,
        period_s: float,
        **options: Any,
    ):
        self._builder = builder
        self._kinematics = kinematics
        self._plant_state = plant_state
        self._period_s = period_s
        self._options = options
        self._observers: dict[tuple[float, float], StateObserver] = {}
        self._sources: list[RandomSource] = []

    def add(self, name: str, noise: ObservationNoise) -> StateObserver:
        """The observer of a strength of noise: a new one, or the one that is there already.

        Args:
            name: Name of the system, if it is new.
            noise: Standard deviations.
        """
        key = (noise.position, noise.velocity)
        if key in self._observers:
            return self._observers[key]
        observer = self._builder.AddNamedSystem(
            name, StateObserver(self._kinematics, noise, **self._options)
        )
        self._builder.Connect(self._plant_state, observer.GetInputPort("plant_state"))
        if key != (0.0, 0.0):
            noise_port = observer.GetInputPort("noise")
            source = self._builder.AddNamedSystem(
                f"{name}_noise",
                RandomSource(RandomDistribution.kGaussian, noise_port.size(), self._period_s),
            )
            self._builder.Connect(source.get_output_port(), noise_port)
            self._sources.append(source)
        self._observers[key] = observer
        return observer

    def reseed(self, context: Context, rng: np.random.Generator | None) -> None:
        """Gives every source a seed of its own, and so new noise.

        Args:
            context: The root Context.
            rng: Source of the seeds; None for noise that is always the same.
        """
        rng = np.random.default_rng(0) if rng is None else rng
        for source in self._sources:
            source.SetRandomContext(
                source.GetMyMutableContextFromRoot(context),
                RandomGenerator(int(rng.integers(2**31))),
            )

    def silence(self, context: Context) -> None:
        """Takes the noise out of this instant, up to the next draw.

        Args:
            context: The root Context.
        """
        for source in self._sources:
            source_context = source.GetMyMutableContextFromRoot(context)
            source_context.get_mutable_discrete_state_vector().SetZero()


def combined(one: ObservationNoise, other: ObservationNoise) -> ObservationNoise:
    """The noise of two independent sources together."""
    return ObservationNoise(
        position=math.hypot(one.position, other.position),
        velocity=math.hypot(one.velocity, other.velocity),
    )
