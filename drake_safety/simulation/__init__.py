"""Closed loops and what they are made of, scenarios, rollouts, throws, and episodes on disk."""
