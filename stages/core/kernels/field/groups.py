"""Groups of threads that work on one scene: a block of threads on a GPU, one thread on the CPU."""

from __future__ import annotations

import warp as wp

from stages.core.kernels.simd import by_device


@wp.struct
class GroupThread:
    """One of the threads that work on a scene."""

    scene: int
    lane: int  # index within the group
    lanes: int  # number of threads in the group


@wp.func_native(by_device("__syncthreads();", ""))
def wait_for_group():
    """Barrier for the threads of the group; writes before it are visible to all of them after it."""
    ...
