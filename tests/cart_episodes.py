"""Made-up episodes of a cart, and the names of what an episode holds row by row."""

import numpy as np

from drake_safety.learning.segments import Episode, EpisodesInfo

ARRAYS = ("time_s", "state", "true_state", "output", "desired_output", "desired_preview")
ARRAYS += ("features", "margins")


def make_info(**changes):
    fields = dict(
        scenario="cart",
        scenario_hash="ab" * 32,
        variation="nominal",
        seed=7,
        step_s=0.04,
        horizon=2,
        constraint_names=["wall", "speed"],
        state_names=["x", "v", "a"],
        output_names=["x"],
        feature_names=["gap"],
        versions={"numpy": "2.4.6"},
    )
    return EpisodesInfo(**fields | changes)


def make_episode(index, info=None, num_rows=5, **changes):
    info = info or make_info()
    rng = np.random.default_rng(np.random.SeedSequence(info.seed, spawn_key=(index,)))
    num_states, num_outputs = len(info.state_names), len(info.output_names)
    fields = dict(
        index=index,
        time_s=np.arange(num_rows) * info.step_s,
        state=rng.normal(size=(num_rows, num_states)),
        true_state=rng.normal(size=(num_rows, num_states)),
        output=rng.normal(size=(num_rows, num_outputs)),
        desired_output=rng.normal(size=(num_rows, num_outputs)),
        desired_preview=rng.normal(size=(num_rows, info.horizon * num_outputs)),
        features=rng.normal(size=(num_rows, len(info.feature_names))),
        margins=(np.abs, np.positive)[index % 2](
            rng.normal(size=(num_rows, len(info.constraint_names)))
        ),
        is_safe=index % 2 == 0,
        cause="" if index % 2 == 0 else info.constraint_names[0],
        first_step=index % 3,
        num_controller_failures=index % 4,
    )
    return Episode(**fields | changes)


def assert_identical(episodes, others):
    """Bit for bit."""
    for one, other in zip(episodes, others, strict=True):
        for name, value in vars(one).items():
            a, b = np.asarray(value), np.asarray(getattr(other, name))
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), name
