import os
import subprocess
import sys
import threading

import pytest
import torch

from splatart_ns.threads import kernel_threads, num_threads, side_by_side


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_results_come_in_order_from_as_many_threads_as_torch_has(two_threads):
    both = threading.Barrier(2, timeout=20)  # breaks unless two run at the same time

    def function(item: int) -> tuple[int, int]:
        both.wait()
        return item, torch.get_num_threads()

    assert side_by_side(function, range(4)) == [(i, 1) for i in range(4)]
    assert torch.get_num_threads() == 2


def test_threads_that_start_later_have_torchs_number_again(two_threads):
    side_by_side(lambda item: item, range(2))
    found = []
    later = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    later.start()
    later.join()
    assert found == [2]


@pytest.mark.parametrize("threads", [1, 2])
def test_gradients_are_recorded_also_where_the_caller_wants_none(two_threads, threads):
    torch.set_num_threads(threads)
    with torch.no_grad():
        slopes = side_by_side(lambda x: torch.autograd.grad(x.square(), x)[0], [torch.tensor(3.0, requires_grad=True)])
    assert slopes == [6.0]


def test_an_error_of_an_item_reaches_the_caller(two_threads):
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda item: 1 / item, [1, 0])
    assert torch.get_num_threads() == 2


def test_kernels_and_views_have_threads_where_torch_has_one(two_threads):
    at_once = threading.Barrier(3, timeout=20)

    def function(item: int) -> tuple[int, int]:
        at_once.wait()
        return num_threads(), torch.get_num_threads()

    assert num_threads() == 2
    with kernel_threads(3):
        assert (num_threads(), torch.get_num_threads()) == (3, 1)
        assert side_by_side(function, range(3)) == [(1, 1)] * 3
        assert (num_threads(), torch.get_num_threads()) == (3, 1)
    assert (num_threads(), torch.get_num_threads()) == (2, 2)


def test_threads_are_as_before_after_an_error_too(two_threads):
    with kernel_threads(3):
        with pytest.raises(ValueError, match="nothing"), kernel_threads(4):
            raise ValueError("nothing")
        assert num_threads() == 3
    assert (num_threads(), torch.get_num_threads()) == (2, 2)


@pytest.mark.parametrize("module", ["splatart_ns.cli", "splatart_ns.plugin.companion"])
def test_threads_of_a_command_do_not_wake_or_spin_for_small_work_unless_the_user_says_so(module):
    def environment(**given):
        names = "OMP_WAIT_POLICY", "OPENBLAS_NUM_THREADS"
        rest = {name: value for name, value in os.environ.items() if name not in names}
        code = f"import os, {module}; print(*map(os.environ.get, {names}))"
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=rest | given, capture_output=True, text=True, check=True).stdout.split()

    assert environment() == ["PASSIVE", "1"]
    assert environment(OPENBLAS_NUM_THREADS="3") == ["PASSIVE", "3"]
