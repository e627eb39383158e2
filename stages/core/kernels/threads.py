"""Threads on the CPU: a pool for kernels, and the number of threads of PyTorch's operations.

A Warp launch on the CPU runs on the calling thread and releases the GIL, so several threads can launch the parts of a
computation in parallel. The calling thread takes part: it runs the tasks that no pool thread has claimed yet, so when
other processes occupy the cores it does all the work instead of waiting for the pool. The current GPU of CUDA is
per thread and initially GPU 0, so pool threads set that of the caller; "cuda" then means the same device in a task.

PyTorch's operations use OpenMP, whose threads wait passively (see `stages`). Waking them takes longer than most
operations of a small model: 40,000 products take 6 us on one thread and 72 us on two (AMD EPYC). Within
`small_operations` PyTorch's operations run on the calling thread, except within `large_operation`.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from queue import SimpleQueue
from threading import Barrier, Thread
from typing import Any, NamedTuple

import torch

Task = Callable[[], None]


class TaskBatch(NamedTuple):
    """Tasks that several threads run together."""

    tasks: deque[Task]  # not yet claimed
    ended: SimpleQueue[BaseException | None]  # one entry for each finished task: its exception, or None
    gpu: int | None  # current GPU of the caller; None before CUDA is used


def run_parallel(tasks: Sequence[Task]) -> None:
    """Run independent tasks in parallel; return when all have ended.

    At most `torch.get_num_threads()` run at a time. The first exception of a task is raised after all tasks have ended,
    since they may share memory.
    """
    _run(tasks, _helpers(max(0, torch.get_num_threads() - 1))[: len(tasks) - 1])


def _run(tasks: Sequence[Task], helpers: list[SimpleQueue[TaskBatch]]) -> None:
    gpu = torch.cuda.current_device() if torch.cuda.is_initialized() else None
    batch = TaskBatch(deque(tasks), SimpleQueue(), gpu)
    for inbox in helpers:
        inbox.put(batch)
    _work(batch)
    errors = [error for _ in tasks if (error := batch.ended.get()) is not None]
    if errors:
        raise errors[0]


def parallel_map(function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Apply a function to independent items in parallel; return the results in order.

    For functions that spend their time in NumPy, SciPy or PyTorch, which release the GIL. PyTorch's operations within
    run on one thread, so that results do not depend on which thread takes an item. Gradient and inference modes are
    those of the caller.
    """
    results: list[Any] = [None] * len(items)
    gradients, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def task(i: int) -> None:
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            results[i] = function(items[i])

    helpers = _helpers(max(0, torch.get_num_threads() - 1))[: max(0, len(items) - 1)]
    with small_operations():
        _run([partial(task, i) for i in range(len(items))], helpers)
    return results


def _work(batch: TaskBatch) -> None:
    """Claim and run tasks until none is left."""
    while batch.tasks:
        try:
            task = batch.tasks.popleft()
        except IndexError:  # another thread was faster
            return
        error = None
        try:
            task()
        except BaseException as raised:  # passed on to the caller of run_parallel
            error = raised
        batch.ended.put(error)


@cache
def _helpers(count: int) -> list[SimpleQueue[TaskBatch]]:
    """Start `count` pool threads, which live as long as the process; return their inboxes."""
    threads, started = torch.get_num_threads(), Barrier(count + 1)
    inboxes: list[SimpleQueue[TaskBatch]] = [SimpleQueue() for _ in range(count)]
    for inbox in inboxes:
        Thread(target=_serve, args=(inbox, started), name="kernels", daemon=True).start()
    started.wait()
    torch.set_num_threads(threads)  # restore the number for this thread and for threads started later
    return inboxes


def _serve(inbox: SimpleQueue[TaskBatch], started: Barrier) -> None:
    torch.set_num_threads(1)  # applies to this thread
    started.wait()
    while True:
        batch = inbox.get()
        if batch.gpu is not None:
            torch.cuda.set_device(batch.gpu)
        _work(batch)


_thread_count: list[int] = []  # stack of the numbers of threads outside of each active `small_operations`


@contextmanager
def small_operations() -> Iterator[None]:
    """Run PyTorch's operations on the calling thread alone, except within `large_operation`."""
    _thread_count.append(torch.get_num_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_thread_count.pop())


@contextmanager
def large_operation() -> Iterator[None]:
    """Run PyTorch's operations within `small_operations` on all threads again; elsewhere this has no effect."""
    before = torch.get_num_threads()
    if _thread_count:
        torch.set_num_threads(_thread_count[0])
    try:
        yield
    finally:
        if _thread_count:
            torch.set_num_threads(before)


if hasattr(os, "register_at_fork"):  # a forked child does not inherit the pool threads of its parent
    os.register_at_fork(after_in_child=_helpers.cache_clear)
