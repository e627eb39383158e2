"""Linear system of a Newton step of the contact solver: assembly from the contacts, LDL' decomposition and solution.

Bodies are ordered so that touching ones are close together, which makes the Hessian banded. It is decomposed in place.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.field.contact_impulses import (
    ONE,
    ContactSolver,
    Decomposition,
    SolverMemory,
    contact_count,
    contact_hessian,
    contact_impulse,
    has_contacts,
    relative_velocity,
)
from stages.core.kernels.field.groups import GroupThread, wait_for_group
from stages.core.kernels.simd import by_device

f64 = wp.float64

# Sum over k = start .. end - 1 of H[i + k] H[j + k] inverse[k], of one scene
_ROWS = r"""
const double* a = d.H.data + (size_t)scene * d.H.shape[1] + i;
const double* b = d.H.data + (size_t)scene * d.H.shape[1] + j;
const double* inverse = d.inverse.data + (size_t)scene * d.inverse.shape[1];
double sum = 0.0;
int k = start;
"""
_VECTORS = r"""
typedef double D __attribute__((ext_vector_type(4)));  // the compiler may not reorder sums
auto load = [](const double* p) { D v; __builtin_memcpy(&v, p, sizeof(v)); return v; };
D s = 0.0, t = 0.0;
for (; k + 8 <= end; k += 8) {
    s += load(a + k) * load(b + k) * load(inverse + k);
    t += load(a + k + 4) * load(b + k + 4) * load(inverse + k + 4);
}
s += t;
sum = (s[0] + s[1]) + (s[2] + s[3]);
"""
_SCALARS = r"""
for (; k < end; ++k) sum += a[k] * b[k] * inverse[k];
return sum;
"""


@wp.func
def _evaluate(s: ContactSolver, scene: int, i: int):
    """Evaluate the terms of contact i: G, K_a G, K_b G, K_a G K_a', K_a G K_b', K_b G K_b', and J, K_a J, K_b J.

    G is the contact's Hessian, J its impulse, and K_a, K_b are the cross-product matrices of its arms.
    """
    relative = relative_velocity(s.contacts, s.velocities, scene, i)
    G = contact_hessian(s.contacts, scene, i, relative, s.memory.bound[scene, i])
    J = contact_impulse(s.contacts, scene, i, relative, s.memory.bound[scene, i])
    K_a = wp.skew(s.contacts.arm_a[scene, i])
    K_b = wp.skew(s.contacts.arm_b[scene, i])
    s.memory.relative[scene, i] = relative
    s.memory.matrices[scene, i, 0] = G
    s.memory.matrices[scene, i, 1] = K_a * G
    s.memory.matrices[scene, i, 2] = K_b * G
    s.memory.matrices[scene, i, 3] = K_a * G * wp.transpose(K_a)
    s.memory.matrices[scene, i, 4] = K_a * G * wp.transpose(K_b)
    s.memory.matrices[scene, i, 5] = K_b * G * wp.transpose(K_b)
    s.memory.vectors[scene, i, 0] = J
    s.memory.vectors[scene, i, 1] = K_a * J
    s.memory.vectors[scene, i, 2] = K_b * J


@wp.func
def _sum_pair(s: ContactSolver, scene: int, pair: int, term: int):
    """Sum one of the six matrix terms (0..5) or three vector terms (6..8) over the contacts of a pair."""
    if term < 6:
        matrix = wp.mat33d()
        for i in range(s.contacts.first[scene, pair], s.contacts.first[scene, pair + 1]):
            matrix += s.memory.matrices[scene, i, term]
        s.memory.pair_matrices[scene, pair, term] = matrix
    else:
        vector = wp.vec3d()
        for i in range(s.contacts.first[scene, pair], s.contacts.first[scene, pair + 1]):
            vector += s.memory.vectors[scene, i, term - 6]
        s.memory.pair_vectors[scene, pair, term - 6] = vector


@wp.struct
class HessianBlock:
    """6 x 6 block of the Hessian: rows of one body, columns of another or the same body; first linear, then angular."""

    top: wp.mat33d  # linear rows, linear columns
    right: wp.mat33d  # linear rows, angular columns
    left: wp.mat33d  # angular rows, linear columns
    bottom: wp.mat33d  # angular rows, angular columns


@wp.func
def _write_block(memory: SolverMemory, scene: int, i: int, j: int, block: HessianBlock):
    """Write the block of the bodies of ranks i and j to the Hessian."""
    n = 6 * memory.rank.shape[1]
    for r in range(3):
        for k in range(3):
            memory.decomposition.H[scene, (6 * i + r) * n + 6 * j + k] = block.top[r, k]
            memory.decomposition.H[scene, (6 * i + r) * n + 6 * j + 3 + k] = block.right[r, k]
            memory.decomposition.H[scene, (6 * i + 3 + r) * n + 6 * j + k] = block.left[r, k]
            memory.decomposition.H[scene, (6 * i + 3 + r) * n + 6 * j + 3 + k] = block.bottom[r, k]


@wp.func
def _assemble_own(s: ContactSolver, scene: int, i: int):
    """Assemble the diagonal block of body i, and its part of the negative gradient."""
    bodies = s.memory.rank.shape[1]
    n = 6 * bodies
    eye = wp.identity(3, dtype=f64)
    block = HessianBlock()
    block.top = eye
    block.bottom = eye
    force = wp.vec3d()
    torque = wp.vec3d()
    if not s.inertia.pinned[scene, i]:
        mass = f64(s.inertia.mass[scene, i])
        block.top = mass * eye
        block.bottom = s.inertia.tensor[scene, i]
        force = -mass * (s.velocities.linear[scene, i] - s.free.linear[scene, i])
        torque = -(block.bottom * (s.velocities.angular[scene, i] - s.free.angular[scene, i]))
        for other in range(bodies):
            pair = i * bodies + other
            if has_contacts(s.contacts, scene, pair):
                block.top += s.memory.pair_matrices[scene, pair, 0]
                block.left += s.memory.pair_matrices[scene, pair, 1]
                block.bottom += s.memory.pair_matrices[scene, pair, 3]
                force += s.memory.pair_vectors[scene, pair, 0]
                torque += s.memory.pair_vectors[scene, pair, 1]
            pair = other * bodies + i
            if other != i and has_contacts(s.contacts, scene, pair):
                block.top += s.memory.pair_matrices[scene, pair, 0]
                block.left += s.memory.pair_matrices[scene, pair, 2]
                block.bottom += s.memory.pair_matrices[scene, pair, 5]
                force -= s.memory.pair_vectors[scene, pair, 0]
                torque -= s.memory.pair_vectors[scene, pair, 2]
    block.right = wp.transpose(block.left)
    row = s.memory.rank[scene, i]
    _write_block(s.memory, scene, row, row, block)
    for k in range(3):
        s.memory.decomposition.H[scene, n * n + 6 * row + k] = force[k]
        s.memory.decomposition.H[scene, n * n + 6 * row + 3 + k] = torque[k]


@wp.func
def _assemble_pair(s: ContactSolver, scene: int, i: int, j: int):
    """Assemble the block of body i and a body j of lower rank."""
    bodies = s.memory.rank.shape[1]
    block = HessianBlock()
    if not (s.inertia.pinned[scene, i] or s.inertia.pinned[scene, j]):
        pair = i * bodies + j
        if has_contacts(s.contacts, scene, pair):
            block.top -= s.memory.pair_matrices[scene, pair, 0]
            block.right -= wp.transpose(s.memory.pair_matrices[scene, pair, 2])
            block.left -= s.memory.pair_matrices[scene, pair, 1]
            block.bottom -= s.memory.pair_matrices[scene, pair, 4]
        pair = j * bodies + i
        if has_contacts(s.contacts, scene, pair):
            block.top -= s.memory.pair_matrices[scene, pair, 0]
            block.right -= wp.transpose(s.memory.pair_matrices[scene, pair, 1])
            block.left -= s.memory.pair_matrices[scene, pair, 2]
            block.bottom -= wp.transpose(s.memory.pair_matrices[scene, pair, 4])
    _write_block(s.memory, scene, s.memory.rank[scene, i], s.memory.rank[scene, j], block)


@wp.func
def assemble(s: ContactSolver, thread: GroupThread):
    """Assemble the Hessian and the negative gradient at the current velocities."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    for i in range(thread.lane, contact_count(s.contacts, scene), thread.lanes):
        _evaluate(s, scene, i)
    wait_for_group()
    for k in range(thread.lane, 9 * s.contacts.active_count[scene], thread.lanes):
        _sum_pair(s, scene, s.contacts.active[scene, k // 9], k % 9)
    wait_for_group()
    for i in range(thread.lane, bodies, thread.lanes):
        _assemble_own(s, scene, i)
    for i in range(thread.lane, bodies, thread.lanes):  # i and j are ranks here
        for j in range(s.memory.first_rank[scene, i], i):
            _assemble_pair(s, scene, s.memory.order[scene, i], s.memory.order[scene, j])
    wait_for_group()


@wp.func_native(_ROWS + by_device("", _VECTORS) + _SCALARS)
def _weighted_product(d: Decomposition, scene: int, i: int, j: int, start: int, end: int) -> f64: ...


@wp.func
def factorise(memory: SolverMemory, thread: GroupThread):
    """Decompose the Hessian into LDL' in place, and solve the last row (the negative gradient) with L.

    Each row starts at the first rank that its body is coupled to.
    """
    d = memory.decomposition
    scene = thread.scene
    n = 6 * memory.rank.shape[1]
    for j in range(n):
        start_j = 6 * memory.first_rank[scene, j // 6]
        end = 6 * memory.last_rank[scene, j // 6] + 6
        for row in range(j + thread.lane, end + 1, thread.lanes):
            i = row
            start = start_j
            if row < end:
                start = wp.max(start, 6 * memory.first_rank[scene, i // 6])
            else:
                i = n
            if start <= j:
                s = d.H[scene, i * n + j]
                s -= _weighted_product(d, scene, i * n, j * n, start, j)
                d.H[scene, i * n + j] = s
                if i == j:
                    d.inverse[scene, j] = ONE / s
        wait_for_group()


@wp.func
def back_substitute(memory: SolverMemory, thread: GroupThread):
    """Compute the Newton step from the decomposition."""
    d = memory.decomposition
    scene = thread.scene
    bodies = memory.rank.shape[1]
    n = 6 * bodies
    for back in range(n):
        j = n - 1 - back
        x = d.H[scene, n * n + j] * d.inverse[scene, j]
        for i in range(6 * memory.first_rank[scene, j // 6] + thread.lane, j, thread.lanes):
            d.H[scene, n * n + i] = d.H[scene, n * n + i] - d.H[scene, j * n + i] * x
        wait_for_group()
    for i in range(thread.lane, bodies, thread.lanes):
        linear = wp.vec3d()
        angular = wp.vec3d()
        row = 6 * memory.rank[scene, i]
        for k in range(3):
            linear[k] = d.H[scene, n * n + row + k] * d.inverse[scene, row + k]
            angular[k] = d.H[scene, n * n + row + 3 + k] * d.inverse[scene, row + 3 + k]
        memory.step.linear[scene, i] = linear
        memory.step.angular[scene, i] = angular
    wait_for_group()


@wp.func
def _coupled(s: ContactSolver, scene: int, i: int, j: int) -> bool:
    bodies = s.memory.rank.shape[1]
    free = not (s.inertia.pinned[scene, i] or s.inertia.pinned[scene, j])
    touching = has_contacts(s.contacts, scene, i * bodies + j) or has_contacts(s.contacts, scene, j * bodies + i)
    return free and touching


@wp.func
def sort_bodies(s: ContactSolver, scene: int):
    """Order the bodies by breadth-first search, island by island (Cuthill and McKee 1969), for a banded Hessian."""
    bodies = s.memory.rank.shape[1]
    for i in range(bodies):
        s.memory.rank[scene, i] = -1
    end = int(0)
    for i in range(bodies):
        if s.memory.rank[scene, i] < 0:
            s.memory.rank[scene, i] = end
            s.memory.order[scene, end] = i
            at = int(end)
            end += 1
            while at < end:
                body = s.memory.order[scene, at]
                least = int(at)
                for j in range(bodies):
                    if j != body and _coupled(s, scene, body, j):
                        if s.memory.rank[scene, j] < 0:
                            s.memory.rank[scene, j] = end
                            s.memory.order[scene, end] = j
                            end += 1
                        least = wp.min(least, s.memory.rank[scene, j])
                s.memory.first_rank[scene, at] = least
                for rank in range(least, at + 1):
                    s.memory.last_rank[scene, rank] = at
                at += 1
