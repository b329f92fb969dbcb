"""No tick of ours spins BLAS' threads, and the user's settings are left as they are."""

import time
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from drake_safety import load_assessment, load_scenario
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD
from system_doubles import begun


def num_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        yield


def test_nested_contexts_and_errors_restore_the_settings():
    @ONE_BLAS_THREAD
    def fail():
        with ONE_BLAS_THREAD:
            assert num_threads() == {1}
        assert num_threads() == {1}
        raise ZeroDivisionError

    assert num_threads() == {2}
    with pytest.raises(ZeroDivisionError):
        fail()
    assert num_threads() == {2}


def test_ticks_of_several_threads_restore_the_settings_after_the_last_one():
    barrier = Barrier(4, timeout=30.0)

    def tick(_):
        with ONE_BLAS_THREAD:
            barrier.wait()  # All are within it.
            numbers = num_threads()
            barrier.wait()
        return numbers

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(tick, range(4))) == [{1}] * 4
    assert num_threads() == {2}


def test_simulation_with_gamma_uses_no_cpu_time_in_threads_of_blas():
    loop = load_scenario("atlas_reaching").make_loop(assessment=load_assessment("atlas_reaching"))
    simulator, _ = begun(loop, loop.reset, np.random.default_rng(0))
    simulator.AdvanceTo(0.1)
    # A product that is threaded: its threads spin for a while after it.
    started = time.process_time() - time.thread_time()
    deadline = time.monotonic() + 5.0
    while time.process_time() - time.thread_time() - started < 0.01:
        assert time.monotonic() < deadline, "BLAS has no threads here, so this shows nothing"
        np.ones((400, 400)) @ np.ones((400, 400))
    time.sleep(0.5)
    process_s, thread_s = time.process_time(), time.thread_time()
    simulator.AdvanceTo(0.6)
    thread_s = time.thread_time() - thread_s
    process_s = time.process_time() - process_s
    assert thread_s > 0.01
    assert process_s - thread_s < 0.05 * thread_s


def final_values(loop, seed):
    simulator, context = begun(loop, loop.reset, np.random.default_rng(seed))
    simulator.AdvanceTo(0.2)
    ports = ("state", "features", "margins", "belief")
    return np.concatenate([loop.GetOutputPort(name).Eval(context) for name in ports])


def test_threads_with_one_diagram_give_the_same_bits_as_one_after_the_other():
    name = "laikago_balancing"
    loop = load_scenario(name).make_loop("actual", assessment=load_assessment(name))
    alone = [final_values(loop, seed) for seed in range(4)]
    assert len({values.tobytes() for values in alone}) == 4
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda seed: final_values(loop, seed), range(4)))
    np.testing.assert_array_equal(alone, together)
