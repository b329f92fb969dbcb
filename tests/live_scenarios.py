"""Scenarios that are learned from in a second, for live sessions."""

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.rollouts import run_episodes


def quick(scenario):
    """Trains in a second; what is learned is of no account here."""
    parameters = scenario.assessment
    parameters.epochs, parameters.ensemble_size, parameters.hidden_sizes = 20, 1, [32]
    parameters.perplexity, parameters.min_count = 5, 1
    return scenario


def learned(scenario, num_episodes=30):
    episodes = run_episodes(scenario, num_episodes, num_workers=1)
    return SafetyAssessment(scenario.assessment).fit(episodes)
