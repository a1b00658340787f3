"""Processes of this machine."""

import operator
import os
import threading
import time
from multiprocessing.context import SpawnProcess

import pytest

from splatart_ns.batch.pool import Death, ProcessPool
from splatart_ns.batch.stage import Needs


@pytest.fixture
def pool():
    pools = []

    def make(*arguments):
        pools.append(ProcessPool(*arguments))
        return pools[-1]

    yield make
    for one in pools:
        one.close()


def results(pool, count):
    ended = []
    while len(ended) < count:
        ended += pool.wait(10.0)
    return dict(ended)


def test_results_come_with_their_tickets(pool):
    pool = pool(2, 1000, {})
    pool.start("a", Needs(), pow, 2, 5)
    pool.start("b", Needs(), pow, 3, 2)
    assert not pool.fits(Needs())
    assert results(pool, 2) == {"a": 32, "b": 9}
    assert pool.wait(0.0) == []


def test_a_task_waits_until_its_memory_is_free_and_starts_at_last(pool):
    pool = pool(4, 1000, {})
    pool.start("a", Needs(memory_mb=700), abs, 1)
    assert pool.fits(Needs(memory_mb=300)) and not pool.fits(Needs(memory_mb=301))
    results(pool, 1)
    assert pool.fits(Needs(memory_mb=5000))  # more than there is: alone


def test_a_process_leaves_no_file_behind_even_if_it_is_killed(pool, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    pool = pool(1, 1000, {})
    pool.start("a", Needs(), os.listdir, tmp_path)
    assert results(pool, 1) == {"a": []}


def test_a_process_that_ends_before_it_can_serve_leaves_no_file_behind(pool, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("splatart_ns.batch.pool._serve", operator.is_)  # which does nothing, and returns
    pool = pool(1, 1000, {})
    pool.start("a", Needs(), abs, -1)
    assert results(pool, 1)["a"] == Death("the process ended with exit code 0: no word")
    assert os.listdir(tmp_path) == []


def test_a_process_that_dies_takes_its_own_task_alone(pool):
    pool = pool(2, 1000, {})
    pool.start("ends", Needs(), os._exit, 7)
    pool.start("sleeps", Needs(), time.sleep, 0.2)
    ended = results(pool, 2)
    assert ended["sleeps"] is None
    assert isinstance(ended["ends"], Death) and "exit code 7" in ended["ends"].how
    pool.start("next", Needs(), abs, -1)
    assert results(pool, 1) == {"next": 1}


def where(ended):
    return sorted(ended.values())


def test_processes_share_the_gpus_evenly_up_to_four_each(pool):
    pool = pool(10, 100000, {"0": 16000, "1": 16000})
    on_gpu = Needs(memory_mb=1000, gpu=True)
    for ticket in range(2):
        pool.start(ticket, on_gpu, os.getenv, "CUDA_VISIBLE_DEVICES")
    assert where(results(pool, 2)) == ["0", "1"]
    for ticket in range(8):
        assert pool.fits(on_gpu)
        pool.start(ticket, on_gpu, os.getenv, "CUDA_VISIBLE_DEVICES")
    assert not pool.fits(on_gpu) and pool.fits(Needs())
    pool.start("cpu", Needs(), os.getenv, "CUDA_VISIBLE_DEVICES")
    assert where(results(pool, 9)) == [""] + 4 * ["0"] + 4 * ["1"]


def test_a_task_goes_to_the_gpu_that_has_least_to_do(pool):
    pool = pool(8, 100000, {"0": 16000, "1": 16000})
    on_gpu = Needs(memory_mb=1000, gpu=True)
    for ticket, seconds in enumerate((0.0, 60.0, 60.0, 0.0, 60.0)):  # on the one and the other by turns
        pool.start(ticket, on_gpu, time.sleep, seconds)
    assert set(results(pool, 2)) == {0, 3}
    pool.start("next", on_gpu, os.getenv, "CUDA_VISIBLE_DEVICES")
    assert results(pool, 1) == {"next": "1"}


def test_a_gpu_has_the_processes_that_its_memory_has_room_for(pool):
    pool = pool(8, 100000, {"0": 5000})
    pool.start("a", Needs(memory_mb=3000, gpu=True), abs, 1)
    assert pool.fits(Needs(memory_mb=1500, gpu=True)) and not pool.fits(Needs(memory_mb=1501, gpu=True))
    results(pool, 1)
    assert pool.fits(Needs(memory_mb=9000, gpu=True))  # more than it has: alone


def test_a_gpu_of_unknown_memory_has_one_process(pool):
    pool = pool(8, 100000, {"MIG-1": 0})
    pool.start("a", Needs(memory_mb=1000, gpu=True), os.getenv, "CUDA_VISIBLE_DEVICES")
    assert not pool.fits(Needs(gpu=True))
    assert results(pool, 1) == {"a": "MIG-1"}


def test_without_more_cores_than_gpu_processes_these_do_the_rest(pool):
    pool = pool(1, 10000, {"3": 8000})
    pool.start("a", Needs(gpu=True), os.getenv, "CUDA_VISIBLE_DEVICES")
    assert results(pool, 1) == {"a": "3"}
    assert pool.fits(Needs())


def test_pools_in_two_threads_start_processes_with_the_right_environment(pool, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    start = SpawnProcess.start

    def slow_start(process):
        time.sleep(0.2)
        start(process)

    monkeypatch.setattr(SpawnProcess, "start", slow_start)
    pools = [pool(1, 1000, {}), pool(1, 1000, {})]

    def run(number):
        time.sleep(0.1 * number)
        pools[number].start(number, Needs(), os.getenv, "OMP_NUM_THREADS")

    threads = [threading.Thread(target=run, args=(number,)) for number in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [results(pool, 1) for pool in pools] == [{0: "1"}, {1: "1"}]
    assert "OMP_NUM_THREADS" not in os.environ
