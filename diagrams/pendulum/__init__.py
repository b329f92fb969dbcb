"""Pendulum: a small task without legs, an example for tasks of your own."""

from drake_safety.diagrams.pendulum.task import Pendulum as Pendulum
