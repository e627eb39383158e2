"""Groups of threads that work on one scene: a block of threads on a GPU, one thread on the CPU."""

from __future__ import annotations

import warp as wp

from stages.core.kernels.simd import by_device


@wp.struct
class GroupThread:
    """One of the threads that work on a scene."""

    scene: int
    lane: int  # its number in the group
    lanes: int  # threads of the group


@wp.func_native(by_device("__syncthreads();", ""))
def wait_for_group():
    """Wait until all threads of the group are here; what they wrote before can then be read by all."""
    ...
