"""Balancing: a quadruped keeps its base on a plan while balls hit it; it can step to recover."""

from drake_safety.diagrams.balancing.task import Balancing as Balancing
