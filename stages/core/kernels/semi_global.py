"""Path costs of semi-global matching along one dimension, forward plus backward.

On CUDA one thread block aggregates each line, with one thread per label. On the CPU each thread processes some of the
lines with the PyTorch operations of the reference.

Source: Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", eq. 13.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view
from stages.core.kernels.simd import by_device
from stages.core.kernels.threads import parallel_map

wp.set_module_options({"enable_backward": False})

THREADS = 256
GRAIN_SIZE = 32768  # elements per thread below which PyTorch adds no further thread (at::internal::GRAIN_SIZE)

_FOLLOW = r"""
__shared__ float before[258], lowest_of_warp[8];
const int steps = costs.shape[0], lines = costs.shape[1], labels = costs.shape[2];
const int t = threadIdx.x;
const float none = INFINITY;
for (int direction = 0; direction < 2; ++direction) {
    float path = none;
    for (int step = 0; step < steps; ++step) {
        const int k = direction ? steps - 1 - step : step;
        const long long at = ((long long)k * lines + line) * labels + t;
        const float cost = t < labels ? costs.data[at] : none;
        __syncthreads();  // the row before is no longer read
        before[t + 1] = path;
        if (t == 0) before[0] = before[257] = none;
        float lowest = path;
        for (int offset = 16; offset; offset /= 2)
            lowest = fminf(lowest, __shfl_xor_sync(0xffffffff, lowest, offset));
        if (t % 32 == 0) lowest_of_warp[t / 32] = lowest;
        __syncthreads();
        for (int w = 0; w < 8; ++w) lowest = fminf(lowest, lowest_of_warp[w]);
        if (step == 0) path = cost;
        else {
            const float near = fminf(before[t], before[t + 2]) + step_penalty;
            path = cost + fminf(fminf(path, near), lowest + jump_penalty) - lowest;
        }
        if (t < labels) total.data[at] = direction ? total.data[at] + path : path;
        else path = none;
    }
}
"""


@wp.func_native(by_device(_FOLLOW, ""))
def _follow(
    line: int, costs: wp.array3d[float], step_penalty: float, jump_penalty: float, total: wp.array3d[float]
): ...  # fmt: skip


@wp.kernel
def _paths(costs: wp.array3d[float], step_penalty: float, jump_penalty: float, total: wp.array3d[float]):
    _follow(wp.tid() // wp.static(THREADS), costs, step_penalty, jump_penalty, total)


def path_costs(costs: Float[Tensor, "l m d"], step_penalty: float, jump_penalty: float) -> Float[Tensor, "l m d"]:
    """Aggregate the costs of d labels along the first dimension, forward plus backward, for each of the m lines.

    A label change of one costs `step_penalty`, a larger change `jump_penalty`.
    """
    _, lines, labels = costs.shape
    if not costs.is_cuda:
        parts = costs.chunk(min(torch.get_num_threads(), -(-lines * labels // GRAIN_SIZE)), dim=1)
        return torch.cat(parallel_map(lambda part: path_costs_reference(part, step_penalty, jump_penalty), parts), 1)
    if labels > THREADS:
        return path_costs_reference(costs, step_penalty, jump_penalty)
    costs = costs.contiguous()
    total = torch.empty_like(costs)
    arguments = [view(costs), step_penalty, jump_penalty, view(total)]
    launch(_paths, THREADS * lines, arguments, device=device_of(costs), block_dim=THREADS)
    return total


def path_costs_reference(
    costs: Float[Tensor, "l m d"], step_penalty: float, jump_penalty: float
) -> Float[Tensor, "l m d"]:
    """`path_costs` in PyTorch."""
    total = torch.zeros_like(costs)
    for order in (range(len(costs)), range(len(costs) - 1, -1, -1)):
        previous = None
        for k in order:
            if previous is None:
                path = costs[k]
            else:
                lowest = previous.min(-1, keepdim=True).values
                near = F.pad(previous, (1, 1), value=float("inf"))
                near = torch.minimum(near[:, :-2], near[:, 2:]) + step_penalty
                path = costs[k] + torch.minimum(torch.minimum(previous, near), lowest + jump_penalty) - lowest
            total[k] += path
            previous = path
    return total
