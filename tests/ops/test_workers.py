import threading

import pytest
import torch

from cconv.ops.workers import results_of, run_on_workers


@pytest.fixture(autouse=True)
def two_threads():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


def test_each_worker_runs_once_with_one_torch_thread():
    threads = torch.get_num_threads()
    seen = {}
    run_on_workers(lambda worker: seen.update({worker: torch.get_num_threads()}), 2)
    assert seen == {0: 1, 1: 1}
    assert torch.get_num_threads() == threads


def test_one_worker_is_the_calling_thread():
    names = []
    run_on_workers(lambda worker: names.append(threading.current_thread().name), 1)
    assert names == [threading.current_thread().name]


def test_threads_started_later_keep_the_setting():
    run_on_workers(lambda worker: None, 2)
    found = []
    thread = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert found == [torch.get_num_threads()]


def test_an_error_reaches_the_caller():
    def fail(worker):
        raise ValueError(f"worker {worker}")

    threads = torch.get_num_threads()
    for workers in (1, 2):
        with pytest.raises(ValueError, match="worker 0"):
            run_on_workers(fail, workers)
        assert torch.get_num_threads() == threads


@pytest.mark.parametrize("threads", [1, 2])
def test_results_come_in_the_order_of_the_calls(threads):
    torch.set_num_threads(threads)
    assert results_of([lambda: "one", lambda: 2]) == ["one", 2]
    assert results_of([lambda: "alone"]) == ["alone"]
