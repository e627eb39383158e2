"""Capture of kernel launches in CUDA graphs."""

import gc

import pytest
import torch

from stages.core.kernels.cuda_graphs import captured


@pytest.mark.gpu
def test_nothing_is_collected_while_launches_are_captured():
    """A CUDA graph in a reference cycle is freed by the garbage collector, which here runs at every allocation."""
    x = torch.zeros(4, device="cuda")
    x += 1
    unused = [captured(lambda: x.add_(1))]
    unused.append(unused)
    del unused
    thresholds = gc.get_threshold()
    gc.set_threshold(1)
    try:
        graph = captured(lambda: [x.add_(1) for _ in range(100)])
    finally:
        gc.set_threshold(*thresholds)
    assert gc.isenabled()
    graph.replay()
    assert x.tolist() == [101.0] * 4
