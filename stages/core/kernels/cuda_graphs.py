"""Capture of kernel launches as CUDA graphs."""

import gc
from collections.abc import Callable

import torch


def captured(work: Callable[[], object], **options) -> torch.cuda.CUDAGraph:
    """Capture what `work` launches as a CUDA graph; `options` are those of `torch.cuda.graph`.

    Python's garbage collector is off during the capture: freeing an unused graph would invalidate it.
    """
    graph, collects = torch.cuda.CUDAGraph(), gc.isenabled()
    gc.disable()
    try:
        # a stream of the current GPU: torch's default capture stream belongs to the GPU of the first capture
        with torch.cuda.graph(graph, stream=torch.cuda.Stream(), **options):
            work()
    finally:
        if collects:
            gc.enable()
    return graph
