"""Closed loops, scenarios, rollouts, throws, and episodes on disk."""
