"""Observers of one robot in a diagram, one for each noise level."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import AffineSystem, RandomSource

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.mirror import Mirror
from drake_safety.plants.sampled_delay import SampledDelay
from drake_safety.robots.robot import ObservationNoise
from drake_safety.robots.shift import InputShift
from drake_safety.systems.state_observer import StateObserver


class Observers:
    """Adds observers to a diagram, each with its own noise source.

    Args:
        builder: The diagram's builder.
        kinematics: The robot.
        plant_state: Port of its true state.
        period_s: Sampling period of the noise [s].
        **options: Options of every `StateObserver`.
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
        self.mirror: Mirror | None = options.get("mirror")
        self._observers: dict[tuple[float, float], StateObserver] = {}
        self._sources: list[RandomSource] = []

    def add(self, name: str, noise: ObservationNoise) -> StateObserver:
        """Returns the observer of a noise level, and adds it if there is none yet.

        Args:
            name: Name of the system if it is added.
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

    def add_shifted(self, name: str, noise: ObservationNoise, shift: InputShift) -> StateObserver:
        """Adds an observer whose measurement has a fault.

        Args:
            name: Name of the system.
            noise: Standard deviations.
            shift: The fault.
        """
        measured = self.add(f"{name}_measurement", noise).GetOutputPort("measured_plant_state")
        n_q, n_v = self._kinematics.num_positions, self._kinematics.num_velocities
        scale, bias = np.ones(n_q + n_v), np.zeros(n_q + n_v)
        bias[7:n_q] = shift.joint_bias_rad
        scale[n_q:] = shift.velocity_scale
        delay = SampledDelay(
            len(scale), shift.delay_s, period_s=self._period_s, frozen_at_s=shift.frozen_at_s
        )
        fault = AffineSystem(D=np.diag(scale), y0=bias)
        observer = StateObserver(self._kinematics, **self._options)
        parts = [(f"{name}_delay", delay), (f"{name}_fault", fault), (name, observer)]
        for part_name, system in parts:
            self._builder.AddNamedSystem(part_name, system)
            self._builder.Connect(measured, system.get_input_port(0))
            measured = system.get_output_port(0)
        return observer

    def reseed(self, context: Context, rng: np.random.Generator | None) -> None:
        """Reseeds every noise source.

        Args:
            context: The root Context.
            rng: Source of the seeds; None for fixed seeds.
        """
        rng = np.random.default_rng(0) if rng is None else rng
        for source in self._sources:
            source.SetRandomContext(
                source.GetMyMutableContextFromRoot(context),
                RandomGenerator(int(rng.integers(2**31))),
            )

    def silence(self, context: Context) -> None:
        """Sets the noise to zero until the next sample.

        Args:
            context: The root Context.
        """
        for source in self._sources:
            source_context = source.GetMyMutableContextFromRoot(context)
            source_context.get_mutable_discrete_state_vector().SetZero()


def combined(one: ObservationNoise, other: ObservationNoise) -> ObservationNoise:
    """Noise level of the sum of two independent sources."""
    return ObservationNoise(
        position=math.hypot(one.position, other.position),
        velocity=math.hypot(one.velocity, other.velocity),
    )
