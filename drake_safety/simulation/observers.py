"""Observers of one robot in a diagram, one for each noise level."""

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
        self._builder, self._kinematics, self._options = builder, kinematics, options
        self._plant_state, self._period_s = plant_state, period_s
        self._observers: dict[tuple[float, float], StateObserver] = {}
        self._sources: list[RandomSource] = []

    def add(
        self, name: str, noise: ObservationNoise, faults: Sequence[Fault] = ()
    ) -> StateObserver:
        """Returns the observer of a noise level; adds it if there is none yet, or with faults."""
        if faults:
            measured = self.add(f"{name}_measurement", noise).GetOutputPort("measured_plant_state")
            names = self._kinematics.plant.GetStateNames(add_model_instance_prefix=False)
            period_s = self._period_s
            faulty = add_faults(self._builder, f"{name}_faults", measured, faults, names, period_s)
            return self._added(name, faulty, ObservationNoise())
        key = (noise.position, noise.velocity)
        if key not in self._observers:
            self._observers[key] = self._added(name, self._plant_state, noise)
        return self._observers[key]

    def _added(self, name: str, plant_state: OutputPort, noise: ObservationNoise) -> StateObserver:
        observer = StateObserver(self._kinematics, noise, **self._options)
        self._builder.AddNamedSystem(name, observer)
        self._builder.Connect(plant_state, observer.GetInputPort("plant_state"))
        if (noise.position, noise.velocity) != (0.0, 0.0):
            port = observer.GetInputPort("noise")
            source = RandomSource(RandomDistribution.kGaussian, port.size(), self._period_s)
            self._builder.AddNamedSystem(f"{name}_noise", source)
            self._builder.Connect(source.get_output_port(), port)
            self._sources.append(source)
        return observer

    def reseed(self, context: Context, rng: np.random.Generator | None) -> None:
        """Reseeds every noise source; without ``rng`` with fixed seeds."""
        rng = np.random.default_rng(0) if rng is None else rng
        for source in self._sources:
            generator = RandomGenerator(int(rng.integers(2**31)))
            source.SetRandomContext(source.GetMyMutableContextFromRoot(context), generator)

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
    period_s: float,
    rest: OutputPort | None = None,
) -> OutputPort:
    """Adds faults of a signal, sampled last in each period: after the updates of commands."""
    system = SensorFaults(names, faults, period_s=period_s, offset_s=0.95 * period_s)
    builder.AddNamedSystem(name, system)
    builder.Connect(port, system.GetInputPort("input"))
    if rest is not None and system.HasInputPort("rest"):
        builder.Connect(rest, system.GetInputPort("rest"))
    return system.get_output_port()
