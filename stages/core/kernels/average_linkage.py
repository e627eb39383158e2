"""Agglomerative clustering of a sparse graph by average linkage.

The two clusters with the largest mean edge weight merge until no edge is left. A merge moves the edges of the cluster
of lower degree to the other one. Edges are kept in an indexed binary heap, so that an edge whose weight changes is
moved and an edge that disappears is removed, without stale entries.
"""

from __future__ import annotations

import heapq

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.kernels.interop import compiles_for_cpu, launch, view, with_arrays

wp.set_module_options({"enable_backward": False})

# Half-edge h = 2 e + side is in the linked list of cluster ends[h]; ends[h ^ 1] is the cluster at the other end of
# edge e.
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
    """State of the clustering: n clusters and the m edges between them."""

    ends: wp.array2d[int]  # (m, 2) clusters at both ends of each edge
    sum: wp.array[wp.float64]  # (m,) sum of the weights merged into each edge
    number: wp.array[int]  # (m,) number of these weights
    mean: wp.array[wp.float64]  # (m,) sum / number, the key of the heap
    heap: wp.array[int]  # (m,) edges in heap order
    place: wp.array[int]  # (m,) position of each edge in the heap; -1: removed
    next: wp.array[int]  # (2 m,) next half-edge in the list of the same cluster
    first: wp.array[int]  # (n,) first half-edge in the list of each cluster
    degree: wp.array[int]  # (n,) number of edges of each cluster
    node: wp.array[int]  # (n,) node of the merge tree that each cluster stands for
    edge_to: wp.array[int]  # (n,) edge from the growing cluster to each cluster; -1: none


@wp.func_native(_MERGE)
def _merge_all(graph: ClusterGraph, children: wp.array2d[int], merged: wp.array[int], count: wp.array[int]): ...


@wp.kernel
def _merge(graph: ClusterGraph, children: wp.array2d[int], merged: wp.array[int], count: wp.array[int]):
    _merge_all(graph, children, merged, count)


def average_linkage(
    clusters: int, ends: Int[Tensor, "m 2"], sums: Float[Tensor, "m"], numbers: Int[Tensor, "m"]
) -> tuple[Int[Tensor, "k 2"], Float[Tensor, "k"], Int[Tensor, "k"]]:
    """Cluster a graph by average linkage.

    `clusters` is the number of initial clusters. Edges `ends` are unique and have no loops; `sums` and `numbers` are
    the sum and the count of the weights of each edge. The two clusters with the largest mean weight merge first.

    Returns the two tree nodes that each merge joins, and the sum and the count of the weights between them; merge k
    creates node `clusters` + k. All tensors are on the CPU, since the algorithm is sequential.
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
    node, merges = list(range(clusters)), []  # node[i]: tree node of the cluster in slot i
    while queue:
        value, a, b = heapq.heappop(queue)
        found = links[a].get(b) if links[a] is not None and links[b] is not None else None
        if found is None or -found[0] / found[1] != value:  # stale entry: the edge was merged or its weight changed
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
