"""Assessments that learn the stand-in data quickly, and feedback that contradicts them."""

import copy
import dataclasses
import functools

import numpy as np

from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.assessment_parameters import PaperReading
from drake_safety.learning.calibration import PLAN, Calibration
from drake_safety.learning.feedback import pair_episodes
from drake_safety.learning.maps import MapData
from drake_safety.learning.segments import Episodes, split
from lip_episodes import make_episodes

QUICK = {"perplexity": 15.0, "epochs": 12, "hidden_sizes": [32, 32], "ensemble_size": 2}
QUICK |= {"batch_size": 256, "score_weight": 0.1}
QUICK |= {"paper": PaperReading(epochs=12, hidden_sizes=[48, 48], dropout=0.1)}
NUM_PAIRS = 40


@functools.cache
def quick_episodes():
    return make_episodes(200, noise=0.002)


@functools.cache
def held_out_segments():
    """Segments of episodes that no quick assessment has learned from."""
    return split(make_episodes(150, seed=1, noise=0.002), stride=2, discount=0.99)


@functools.cache
def _learned(mode):
    return SafetyAssessment(AssessmentParameters(mode=mode, **QUICK)).fit(quick_episodes())


def quick_assessment(mode):
    """A copy of one that is learned once for all tests, so that attributes can be replaced."""
    return copy.copy(_learned(mode))


def map_data(x, target, **changes):
    """Training data of a map: inputs that are all safe and have no margins."""
    n = len(x)
    values = dict(x=x, target=target, has_target=np.ones(n, dtype=bool))
    values |= dict(is_unsafe=np.zeros(n, dtype=bool), margins=np.zeros((n, 0)))
    values |= dict(sample_weight=np.ones(n), input_scale=np.ones(x.shape[1]))
    return MapData(**values | changes)


def inputs(segments, rows=slice(None)):
    return segments.state[rows], segments.desired_preview[rows], segments.features[rows]


def pairs_with(flip, num=NUM_PAIRS, seed=3):
    """Pairs of which `flip(episode)` says whether the actual one ends as the twin does not."""
    nominal = make_episodes(num, seed=seed, noise=0.002)
    actual = []
    for episode in nominal:
        if flip(episode):
            is_safe = not episode.is_safe
            cause = "" if is_safe else nominal.info.constraint_names[0]
            episode = dataclasses.replace(episode, is_safe=is_safe, cause=cause)
        actual.append(episode)
    info = dataclasses.replace(nominal.info, variation="actual")
    return pair_episodes(Episodes(info, actual), nominal)


def worse(num=NUM_PAIRS):
    return pairs_with(lambda episode: episode.is_safe and episode.index % 3 == 0, num)


def better(num=NUM_PAIRS):
    return pairs_with(lambda episode: not episode.is_safe and episode.index % 2 == 0, num)


def calibration(**changes):
    values = dict(kind=PLAN, miss_rate=0.05, false_alarm_rate=0.1, confidence=None)
    values |= dict(threshold=0.8, unsafe_below=0.3, num_unsafe=40, num_safe=60, num_missed=1)
    values |= dict(num_accepted=50, seed=7, scenario_hash="abc")
    return Calibration(**values | changes)


def scored_episodes(rng, n=1000, apart=3.0):
    """Unsafe scores of episodes of two classes that overlap, and which are unsafe."""
    label = rng.random(n) < 0.5
    return 1.0 / (1.0 + np.exp(-(rng.normal(size=n) + apart * (label - 0.5)))), label
