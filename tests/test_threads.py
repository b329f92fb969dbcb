from concurrent.futures import ThreadPoolExecutor

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_safety import load_assessment, load_scenario

NUM_THREADS, DURATION_S = 4, 0.2
PORTS = ("state", "features", "margins")


def final_values(loop, seed, ports):
    context = loop.CreateDefaultContext()
    loop.reset(context, np.random.default_rng(seed))
    simulator = Simulator(loop, context)
    simulator.Initialize()
    simulator.AdvanceTo(DURATION_S)
    return np.concatenate([loop.GetOutputPort(name).Eval(context) for name in ports])


def test_threads_with_one_diagram_give_the_same_bits_as_one_after_the_other():
    name = "laikago_balancing"
    assessment = load_assessment(name)
    loop = load_scenario(name).make_loop("actual", assessment=assessment)
    ports = (*PORTS, "belief")
    alone = [final_values(loop, seed, ports) for seed in range(NUM_THREADS)]
    assert len({one.tobytes() for one in alone}) == NUM_THREADS
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        together = list(pool.map(lambda seed: final_values(loop, seed, ports), range(NUM_THREADS)))
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one, other)
