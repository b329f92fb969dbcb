"""Closed loops, scenarios, rollouts, and episodes on disk."""
