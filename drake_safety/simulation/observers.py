"""Observers of one robot in a diagram, one for each noise level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import RandomSource

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.robots.robot import ObservationNoise
from drake_safety.robots.shift import Fault
from drake_safety.systems.sensor_faults import SensorFaults
from drake_safety.systems.state_observer import StateObserver


class Observers:
    """Adds observers to a diagram, each with its own noise source."""

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
        self._faults: list[SensorFaults] = []

    def add(
        self, name: str, noise: ObservationNoise, faults: Sequence[Fault] = ()
    ) -> StateObserver:
        """Returns the observer of a noise level, and adds it if there is none yet.

        One whose measurement has faults is always added.
        """
        if faults:
            return self._add_faulty(name, noise, faults)
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

    def _add_faulty(
        self, name: str, noise: ObservationNoise, faults: Sequence[Fault]
    ) -> StateObserver:
        measured = self.add(f"{name}_measurement", noise).GetOutputPort("measured_plant_state")
        names = self._kinematics.plant.GetStateNames(add_model_instance_prefix=False)
        faulty = add_faults(
            self._builder, f"{name}_faults", measured, faults, names, period_s=self._period_s
        )
        self._faults.append(faulty)
        observer = StateObserver(self._kinematics, **self._options)
        self._builder.AddNamedSystem(name, observer)
        self._builder.Connect(faulty.get_output_port(), observer.GetInputPort("plant_state"))
        return observer

    def reseed(self, context: Context, rng: np.random.Generator | None) -> None:
        """Reseeds every noise source and the noise of faults; without ``rng`` with fixed seeds."""
        rng = np.random.default_rng(0) if rng is None else rng
        for source in self._sources:
            generator = RandomGenerator(int(rng.integers(2**31)))
            source.SetRandomContext(source.GetMyMutableContextFromRoot(context), generator)
        for faulty in self._faults:
            faulty.set_seed(faulty.GetMyMutableContextFromRoot(context), int(rng.integers(2**31)))

    def silence(self, context: Context) -> None:
        """Sets the noise to zero until the next sample."""
        for source in self._sources:
            source_context = source.GetMyMutableContextFromRoot(context)
            source_context.get_mutable_discrete_state_vector().SetZero()


def add_faults(
    builder: DiagramBuilder,
    name: str,
    port: OutputPort,
    faults: Sequence[Fault],
    names: Sequence[str],
    *,
    period_s: float,
) -> SensorFaults:
    """Adds faults of a signal, sampled last in each period: after the updates of commands."""
    system = builder.AddNamedSystem(
        name, SensorFaults(names, faults, period_s=period_s, offset_s=0.95 * period_s)
    )
    builder.Connect(port, system.get_input_port())
    return system


def combined(one: ObservationNoise, other: ObservationNoise) -> ObservationNoise:
    """Noise level of the sum of two independent sources."""
    return ObservationNoise(
        position=math.hypot(one.position, other.position),
        velocity=math.hypot(one.velocity, other.velocity),
    )
