"""Kernel launches as CUDA graphs."""

import gc
from collections.abc import Callable

import torch


def captured(work: Callable[[], object], **options) -> torch.cuda.CUDAGraph:
    """What `work` launches as a CUDA graph, with the options of `torch.cuda.graph`.

    Meanwhile Python collects no garbage: freeing an unused graph would invalidate the capture.
    """
    graph, collects = torch.cuda.CUDAGraph(), gc.isenabled()
    gc.disable()
    try:
        # a stream of the current GPU: the default one is that of the first GPU on which anything was captured
        with torch.cuda.graph(graph, stream=torch.cuda.Stream(), **options):
            work()
    finally:
        if collects:
            gc.enable()
    return graph
