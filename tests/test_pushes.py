import numpy as np

from drake_safety.plants.pushes import Push, RandomPushes


def test_random_pushes_are_horizontal_and_within_their_bounds_as_often_as_they_shall():
    random = RandomPushes(share=0.3, force_n=[50.0, 60.0], time_s=[0.2, 0.4], duration_s=0.1)
    assert Push(force_n=[3.0, 0.0, -4.0]).strength_n == 5.0
    rng = np.random.default_rng(0)
    drawn = [random.sample(rng, "trunk") for _ in range(2000)]
    pushes = [push for push in drawn if push is not None]
    assert 0.26 < len(pushes) / len(drawn) < 0.34
    assert all(50.0 <= push.strength_n <= 60.0 and push.force_n[2] == 0.0 for push in pushes)
    assert all(0.2 <= push.time_s <= 0.4 and push.duration_s == 0.1 for push in pushes)
    assert {push.body for push in pushes} == {"trunk"}
    # All around: a mean of unit vectors is short.
    directions = [np.array(push.force_n) / push.strength_n for push in pushes]
    assert np.linalg.norm(np.mean(directions, axis=0)) < 0.1
