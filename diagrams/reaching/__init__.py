"""Reaching: a humanoid reaches for a target between obstacles with its whole body."""

from drake_safety.diagrams.reaching.task import Reaching as Reaching
