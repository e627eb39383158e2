"""The thread pool for kernels on the CPU."""

import threading
import time

import pytest
import torch
import warp as wp

from stages.core.backends import pick_device
from stages.core.kernels.threads import large_operation, parallel_map, run_parallel, small_operations

LONGEST = 120.0  # longest wait for a busy machine [s]


@pytest.fixture(params=[1, 2, 4])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_each_task_runs_once(threads, count):
    done = []
    run_parallel([lambda i=i: done.append(i) for i in range(count)])
    assert sorted(done) == list(range(count))


def test_results_are_in_the_order_of_the_items(threads):
    """Including tasks that run tasks of their own."""
    assert parallel_map(lambda i: sum(parallel_map(lambda j: i * j, range(4))), range(7)) == [6 * i for i in range(7)]
    assert parallel_map(str, []) == []


@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_tasks_have_the_gradient_mode_of_the_caller(threads, mode):
    with mode():
        expected = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
        barrier = threading.Barrier(threads, timeout=LONGEST)  # makes every thread take a task

        def task(_) -> tuple[bool, bool]:
            barrier.wait()
            return torch.is_grad_enabled(), torch.is_inference_mode_enabled()

        assert parallel_map(task, range(threads)) == [expected] * threads


def test_tasks_have_the_current_gpu_of_the_caller(threads, monkeypatch):
    """Uses a stand-in for CUDA, in which each thread starts with GPU 0, as in PyTorch."""
    own = threading.local()
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: getattr(own, "gpu", 0))
    monkeypatch.setattr(torch.cuda, "set_device", lambda gpu: setattr(own, "gpu", gpu))
    barrier = threading.Barrier(threads, timeout=LONGEST)  # makes every thread take a task

    def task(_) -> int:
        barrier.wait()
        return torch.cuda.current_device()

    for gpu in (1, 0):
        torch.cuda.set_device(gpu)
        assert parallel_map(task, range(threads)) == [gpu] * threads


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two NVIDIA GPUs")
def test_tasks_compute_on_the_gpu_of_the_caller(threads):
    barrier = threading.Barrier(threads, timeout=LONGEST)

    def task(_) -> tuple[int, str]:
        barrier.wait()
        return torch.zeros(1, device="cuda").device.index, str(wp.get_device("cuda"))

    try:
        for gpu in (1, 0):
            assert pick_device(f"cuda:{gpu}") == "cuda"
            assert parallel_map(task, range(threads)) == [(gpu, f"cuda:{gpu}")] * threads
    finally:
        torch.cuda.set_device(0)


def test_an_exception_is_raised_after_all_tasks_have_ended(threads):
    done = []

    def fail():
        raise ValueError("task 0")

    with pytest.raises(ValueError, match="task 0"):
        run_parallel([fail, *(lambda i=i: (time.sleep(0.01), done.append(i)) for i in range(3))])
    assert sorted(done) == [0, 1, 2]
    run_parallel([lambda: done.append(3)] * 2)  # the pool is still usable
    assert done[-2:] == [3, 3]


def test_the_calling_thread_does_the_work_that_no_helper_has_claimed(threads):
    """The caller does not wait for helpers that are busy with other work."""
    release, all_busy, occupied = threading.Event(), threading.Event(), threading.Semaphore(0)

    def block():
        if threading.current_thread().name == "kernels":
            occupied.release()
            release.wait(LONGEST)
        else:
            all_busy.wait(LONGEST)

    def occupy():
        run_parallel([block] * threads)

    other = threading.Thread(target=occupy)
    other.start()
    for _ in range(threads - 1):
        assert occupied.acquire(timeout=LONGEST)
    all_busy.set()
    done = []
    run_parallel([lambda: done.append(threading.current_thread().name)] * 4)
    assert done == [threading.current_thread().name] * 4
    release.set()
    other.join(LONGEST)
    assert not other.is_alive()


def test_small_operations_use_one_thread_and_large_ones_all(threads):
    with large_operation():
        assert torch.get_num_threads() == threads
    with small_operations():
        assert torch.get_num_threads() == 1
        with large_operation():
            assert torch.get_num_threads() == threads
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == threads


def test_number_of_threads_is_restored_after_an_exception(threads):
    with pytest.raises(ValueError, match="inside"), small_operations(), large_operation():
        raise ValueError("inside")
    assert torch.get_num_threads() == threads
