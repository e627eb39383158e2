"""Agglomerative clustering of a sparse graph by average linkage: the closest two clusters merge until no edge is left.

A merge joins the edges of the smaller list to the larger one. Edges wait in a heap in which they keep their place, so
that those that change move and those that vanish leave no trace.
"""

from __future__ import annotations

import heapq

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.kernels.interop import compiles_for_cpu, launch, view, with_arrays

wp.set_module_options({"enable_backward": False})

# A half-edge h = 2 e + side is in the list of cluster ends[h]; ends[h ^ 1] is the cluster at its other side.
_MERGE = r"""
const int clusters = graph.first.shape[0], edges = graph.heap.shape[0];
int *ends = graph.ends.data, *next = graph.next.data, *first = graph.first.data, *degree = graph.degree.data;
int *node = graph.node.data, *edge_to = graph.edge_to.data, *heap = graph.heap.data, *place = graph.place.data;
int* number = graph.number.data;
double *sum = graph.sum.data, *mean = graph.mean.data;
int size = 0, merges = 0;

auto low = [&](int e) { return ends[2 * e] < ends[2 * e + 1] ? ends[2 * e] : ends[2 * e + 1]; };
auto high = [&](int e) { return ends[2 * e] < ends[2 * e + 1] ? ends[2 * e + 1] : ends[2 * e]; };
auto before = [&](int e, int f) {  // the larger mean, then the smaller numbers
    if (mean[e] != mean[f]) return mean[e] > mean[f];
    return low(e) != low(f) ? low(e) < low(f) : high(e) < high(f);
};
auto put = [&](int at, int e) { heap[at] = e; place[e] = at; };
auto settle = [&](int e) {
    int at = place[e];
    for (; at > 0 && before(e, heap[(at - 1) / 2]); at = (at - 1) / 2) put(at, heap[(at - 1) / 2]);
    for (int child; (child = 2 * at + 1) < size; at = child) {
        if (child + 1 < size && before(heap[child + 1], heap[child])) ++child;
        if (!before(heap[child], e)) break;
        put(at, heap[child]);
    }
    put(at, e);
};
auto remove = [&](int e) {
    const int last = heap[--size], at = place[e];
    place[e] = -1;
    if (last == e) return;
    put(at, last);
    settle(last);
};
auto link = [&](int h, int to) { ends[h] = to; next[h] = first[to]; first[to] = h; ++degree[to]; };

for (int i = 0; i < clusters; ++i) { node[i] = i; degree[i] = 0; first[i] = edge_to[i] = -1; }
for (int e = 0; e < edges; ++e) {
    for (int h = 2 * e; h < 2 * e + 2; ++h) link(h, ends[h]);
    mean[e] = sum[e] / number[e];
    put(size++, e);
    settle(e);
}
while (size) {
    const int e = heap[0];
    const bool swap = degree[low(e)] < degree[high(e)];
    const int a = swap ? high(e) : low(e), b = swap ? low(e) : high(e);
    remove(e);
    children.data[2 * merges] = node[a];
    children.data[2 * merges + 1] = node[b];
    merged.data[merges] = e;
    node[a] = clusters + merges++;
    --degree[a];
    for (int* h = first + a; *h >= 0;) {
        if (place[*h / 2] < 0) { *h = next[*h]; continue; }
        edge_to[ends[*h ^ 1]] = *h / 2;
        h = next + *h;
    }
    for (int h = first[b], after; h >= 0; h = after) {
        after = next[h];
        const int mine = edge_to[ends[h ^ 1]];
        if (place[h / 2] < 0) continue;
        if (mine < 0) { link(h, a); settle(h / 2); continue; }
        remove(h / 2);
        --degree[ends[h ^ 1]];
        sum[mine] += sum[h / 2];
        number[mine] += number[h / 2];
        mean[mine] = sum[mine] / number[mine];
        settle(mine);
    }
    for (int h = first[a]; h >= 0; h = next[h]) edge_to[ends[h ^ 1]] = -1;
}
count.data[0] = merges;
"""


@wp.struct
class ClusterGraph:
    """Clusters (n,) and the edges (m,) between them, as they merge."""

    ends: wp.array2d[int]  # (m, 2)
    sum: wp.array[wp.float64]  # (m,), of the weights
    number: wp.array[int]  # (m,) of weights
    mean: wp.array[wp.float64]  # (m,)
    heap: wp.array[int]  # (m,)
    place: wp.array[int]  # (m,) in the heap; -1: merged
    next: wp.array[int]  # (2 m,), in the list of half-edges of a cluster
    first: wp.array[int]  # (n,), of that list
    degree: wp.array[int]  # (n,)
    node: wp.array[int]  # (n,), of the tree
    edge_to: wp.array[int]  # (n,), from the cluster that grows; -1: none


@wp.func_native(_MERGE)
def _merge_all(graph: ClusterGraph, children: wp.array2d[int], merged: wp.array[int], count: wp.array[int]): ...


@wp.kernel
def _merge(graph: ClusterGraph, children: wp.array2d[int], merged: wp.array[int], count: wp.array[int]):
    _merge_all(graph, children, merged, count)


def average_linkage(
    clusters: int, ends: Int[Tensor, "m 2"], sums: Float[Tensor, "m"], numbers: Int[Tensor, "m"]
) -> tuple[Int[Tensor, "k 2"], Float[Tensor, "k"], Int[Tensor, "k"]]:
    """The merges of that many clusters: the two nodes of each, and the sum and the number of the weights between them.

    Edges `ends`, each once and no loop, have the sums of so many weights. The two clusters with the largest mean merge
    first; merge k makes node clusters + k. All tensors are on the CPU, as it is one thread's work.
    """
    if not compiles_for_cpu():
        return average_linkage_reference(clusters, ends, sums, numbers)
    edges = {"ends": ends.int(), "sum": sums.double(), "number": numbers.int()}
    edges = {name: x.clone(memory_format=torch.contiguous_format) for name, x in edges.items()}
    sizes = {"heap": 1, "place": 1, "next": 2}
    room = {name: torch.empty(k * len(ends), dtype=torch.int32) for name, k in sizes.items()}
    room |= {name: torch.empty(clusters, dtype=torch.int32) for name in ("first", "degree", "node", "edge_to")}
    graph = with_arrays(ClusterGraph(), {**edges, **room, "mean": torch.empty_like(edges["sum"])})
    children, merged, count = (torch.empty(shape, dtype=torch.int32)
                               for shape in ((max(clusters, 1), 2), max(clusters, 1), 1))  # fmt: skip
    launch(_merge, 1, [graph, *map(view, (children, merged, count))])
    merged = merged[: int(count)].long()
    return children[: int(count)].long(), edges["sum"][merged], edges["number"][merged].long()


def average_linkage_reference(
    clusters: int, ends: Int[Tensor, "m 2"], sums: Float[Tensor, "m"], numbers: Int[Tensor, "m"]
) -> tuple[Int[Tensor, "k 2"], Float[Tensor, "k"], Int[Tensor, "k"]]:
    """`average_linkage` in Python."""
    links: list[dict[int, tuple[float, int]] | None] = [{} for _ in range(clusters)]
    for (a, b), w, n in zip(ends.tolist(), sums.tolist(), numbers.tolist(), strict=True):
        links[a][b] = links[b][a] = (w, n)
    queue = [(-w / n, a, b) for a, row in enumerate(links) for b, (w, n) in row.items() if a < b]
    heapq.heapify(queue)
    node, merges = list(range(clusters)), []  # node[i]: what stands in slot i
    while queue:
        value, a, b = heapq.heappop(queue)
        found = links[a].get(b) if links[a] is not None and links[b] is not None else None
        if found is None or -found[0] / found[1] != value:  # merged, or changed since it was queued
            continue
        if len(links[a]) < len(links[b]):
            a, b = b, a
        merges.append((node[a], node[b], *found))
        node[a] = clusters + len(merges) - 1
        mine, theirs = links[a], links[b]
        links[b] = None
        del mine[b], theirs[a]
        for other, (w, n) in theirs.items():
            old = mine.get(other)
            new = (w, n) if old is None else (w + old[0], n + old[1])
            mine[other] = links[other][a] = new
            del links[other][b]
            heapq.heappush(queue, (-new[0] / new[1], min(a, other), max(a, other)))
    table = torch.tensor(merges, dtype=torch.float64).reshape(-1, 4)
    return table[:, :2].long(), table[:, 2], table[:, 3].long()
