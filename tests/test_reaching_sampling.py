import numpy as np
import pytest

from drake_safety.diagrams.reaching.sampling import Detours, PostureSampling
from reaching_loops import porter


def test_a_posture_is_safe_with_the_clearance_and_off_the_stops_as_asked():
    safe_set = porter().safe_set
    asked = PostureSampling(
        base_lowering_m=0.04, joint_offset_rad=0.3, clearance_m=0.05, joint_margin_rad=0.1
    )
    loose = PostureSampling(base_lowering_m=0.04, joint_offset_rad=0.3, clearance_m=0.0)
    v = np.zeros(safe_set.kinematics.num_velocities)
    columns = [safe_set.names.index(name) for name in ("collision", "joint_limits")]
    found = {}
    for name, sampling in {"asked": asked, "loose": loose}.items():
        postures = [sampling.sample(safe_set, np.random.default_rng(seed)) for seed in range(25)]
        margins = np.array([safe_set.margins(q, v) for q in postures])
        assert margins.min() > 0
        found[name] = margins[:, columns].min(axis=0)
    assert np.all(found["asked"] >= [0.05, 0.1])
    # It is not for want of others.
    assert np.any(found["loose"] < [0.05, 0.1])


def test_detours_are_made_by_the_share_of_episodes_and_lie_in_their_box():
    detours = Detours(share=0.25, lowest_m=[-0.3, -0.2, 0.0], highest_m=[0.0, 0.2, 0.3])
    rng = np.random.default_rng(0)
    sampled = [detours.sample(rng) for _ in range(400)]
    made = np.array([detour for detour in sampled if detour is not None])
    assert len(made) == pytest.approx(100, abs=30)
    assert np.all((made >= detours.lowest_m) & (made <= detours.highest_m))
    assert np.all(np.ptp(made, axis=0) > 0.2)
    assert Detours().sample(rng) is None
