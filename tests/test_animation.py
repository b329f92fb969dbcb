"""The moving picture of a run."""

import itertools

import numpy as np
import pytest
from PIL import Image

from drake_safety import load_scenario
from studies.animation import save_animation


@pytest.fixture(scope="module")
def loop():
    return load_scenario("laikago_balancing").make_loop(ball=False)


def log_of(loop, num_rows=6):
    q = loop.kinematics.standing_positions()
    positions = np.tile(q, (num_rows, 1))
    positions[:, 6] += np.linspace(0.0, 0.1, num_rows)  # It rises.
    return 0.1 * np.arange(num_rows), positions, np.linspace(1.0, 0.0, num_rows)


def test_a_gif_shows_every_instant_in_real_time(loop, tmp_path):
    time_s, positions, gamma = log_of(loop)
    path = tmp_path / "run.gif"
    save_animation(loop, time_s, positions, gamma, 0.5, path, [0.3])
    with Image.open(path) as gif:
        assert gif.n_frames == 6
        assert gif.info["duration"] == 100
        frames = []
        for i in range(gif.n_frames):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB"), dtype=float))
    robot = slice(0, round(0.75 * len(frames[0])))
    # The robot moves, and so does what is drawn of Gamma below it.
    for before, after in itertools.pairwise(frames):
        assert np.abs(before - after)[robot].max() > 50.0
        assert np.abs(before - after)[robot.stop :].max() > 50.0
