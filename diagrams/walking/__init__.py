"""Walking: a learned policy follows velocity commands."""

from drake_safety.diagrams.walking.task import Walking as Walking
