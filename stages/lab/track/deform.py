"""Deformation of soft objects, in addition to their rigid poses.

Nodes spread over the object are displaced such that renderings agree with the images of all cameras. The displacements
minimise, by Gauss-Newton, the same residuals as the poses plus an as-rigid-as-possible term, which also determines the
parts that no image shows. Each frame starts from the result of the previous one.
Source: Sorkine and Alexa 2007, "As-rigid-as-possible surface modeling"; Sumner, Schmid and Pauly 2007, "Embedded
deformation for shape manipulation".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import nearest_rotation
from stages.core.physics.keypoints import farthest_points, nearest_weights
from stages.core.scene.scene import Scene
from stages.lab.track.alignment import PIXEL_NOISE, Observation, change_of, robust_weights
from stages.lab.track.follow import TrackedMotion, Tracker, motions
from stages.lab.track.poses import Poses
from stages.lab.track.synthesis import Synthesiser

NODES, FOLLOWED, NEIGHBOURS = 40, 4, 6  # nodes of an object, nodes that a point follows, neighbours of a node
STRETCH = 0.05  # edge deformation that weighs like a pixel with error PIXEL_NOISE [edge lengths]
SPEED = 0.1  # node displacement since the last frame that weighs like a pixel with error PIXEL_NOISE [object sizes]
STEPS = {4: 3, 2: 2}  # number of Gauss-Newton steps by image reduction, coarse to fine


@dataclass(frozen=True)
class SoftBody:
    """The deformation nodes of an object, relative to its centre at rest."""

    row: int  # row of the object
    nodes: Float[Tensor, "k 3"]
    edges: Int[Tensor, "e 2"]
    gaussians: Bool[Tensor, "n"]  # mask of this object's Gaussians among those of all objects
    index: Int[Tensor, "m j"]  # nodes that each Gaussian of the object follows
    weight: Float[Tensor, "m j"]  # weights of these nodes

    @staticmethod
    def of(synthesiser: Synthesiser, row: int) -> SoftBody:
        """Distribute nodes over the Gaussians of an object."""
        mine = synthesiser.row == row
        arm = synthesiser.arm[mine]
        nodes = arm[farthest_points(arm, NODES).to(arm.device)]
        near = knn(nodes, nodes, min(NEIGHBOURS + 1, len(nodes)))[1][:, 1:]
        start = torch.arange(len(nodes), device=near.device)[:, None].expand_as(near)
        index, weight = nearest_weights(nodes, arm, FOLLOWED)
        return SoftBody(row, nodes, torch.stack([start, near], -1).flatten(0, 1), mine, index, weight)

    def bent(self, synthesiser: Synthesiser, u: Float[Tensor, "k 3"]) -> Synthesiser:
        """A copy of the synthesiser with this object deformed by displacements of its nodes."""
        other = copy(synthesiser)
        other.arm = synthesiser.arm.clone()
        other.arm[self.gaussians] += (self.weight[..., None] * u[self.index]).sum(1)
        return other

    def displaced(self, u: Float[Tensor, "*t k 3"], points: Float[Tensor, "p 3"]) -> Float[Tensor, "*t p 3"]:
        """Displacements of points that follow the nodes; points are relative to the centre at rest."""
        index, weight = nearest_weights(self.nodes, points, FOLLOWED)
        return (weight[..., None] * u[..., index, :]).sum(-2)


def soft_rows(scene: Scene, names: str) -> list[int]:
    """Rows of the objects in a comma-separated list of names. Raises InputError for unknown names."""
    wanted, known = [n.strip() for n in names.split(",") if n.strip()], [o.name for o in scene.objects]
    if other := [name for name in wanted if name not in known]:
        raise InputError(f"--soft {other[0]}: the scene has no such object; it has {', '.join(known)}")
    return [known.index(name) for name in wanted]


def deformations(
    tracker: Tracker, track: TrackedMotion, rows: Sequence[int]
) -> tuple[TrackedMotion, dict[int, tuple[SoftBody, Float[Tensor, "t k 3"]]]]:
    """Node displacements of soft objects in all frames, and the track with the confidences of the deformed objects."""
    shares, found = track.confidence.clone(), {}
    for row in rows:
        body = SoftBody.of(tracker.synthesiser, row)
        u, all_u = torch.zeros_like(body.nodes), []
        for frame in tqdm(range(len(shares)), desc="deforming", unit="frame", leave=False):
            motion, poses = motions(track, frame), track.poses[frame]
            if frame and track.confidence[frame, row] > 0:
                u = _fit(tracker, body, u, poses, [(tracker.observe(frame, r, *motion), n) for r, n in STEPS.items()])
                bent = copy(tracker)
                bent.synthesiser = body.bent(tracker.synthesiser, u)
                shares[frame, row] = torch.maximum(shares[frame, row], bent.judge(frame, poses, motion)[0][row])
            all_u.append(u)
        found[row] = body, torch.stack(all_u)
    return replace(track, confidence=shares), found


def _fit(
    tracker: Tracker, body: SoftBody, last: Float[Tensor, "k 3"], poses: Poses,
    levels: list[tuple[list[Observation], int]],
) -> Float[Tensor, "k 3"]:  # fmt: skip
    """The displacements that explain the images best, starting from those of the last frame."""
    u, size, scale = last, float(tracker.synthesiser.sizes[body.row]), tracker.scale[body.row]
    slow = (PIXEL_NOISE / (SPEED * size)) ** 2
    for observations, steps in levels:
        for _ in range(steps):
            H, b = _rigidity(body, u)
            H = H + slow * torch.eye(H.shape[0]).to(H)
            b = b + slow * (last - u).flatten()
            synthesiser = body.bent(tracker.synthesiser, u)
            for A, c in (_evidence(synthesiser, body, u, poses, o, scale) for o in observations):
                H, b = H + A, b + c
            u = u + torch.linalg.solve(H.double(), b.double()).float().reshape(-1, 3)
    return u


def _evidence(
    synthesiser: Synthesiser, body: SoftBody, u: Tensor, poses: Poses, seen: Observation, scale: float
) -> tuple[Float[Tensor, "m m"], Float[Tensor, "m"]]:
    """Normal equations of the displacements from one image."""
    drawn = seen.draw(synthesiser, poses)
    change = change_of(seen, drawn, poses.centre)
    mine = change.row == body.row
    then = poses.moved(seen.displacement)
    R, c = then.rotation[body.row], then.centre[body.row]
    point = (drawn.point[drawn.moving >= 0][mine] - c) @ R  # in the rest frame of the object
    r, J = change.residual[mine], change.jacobian[mine][..., 3:] @ R
    k = len(body.nodes)
    H, b = J.new_zeros(k * k, 9), J.new_zeros(k, 3)
    if len(point):
        index, weight = nearest_weights(body.nodes + u, point, FOLLOWED)
        w = robust_weights(r, scale)
        JJ, Jr = torch.einsum("p,pci,pcj->pij", w, J, J).flatten(1), torch.einsum("p,pci,pc->pi", w, J, r)
        for i in range(index.shape[1]):
            b.index_add_(0, index[:, i], weight[:, i, None] * Jr)
            for j in range(index.shape[1]):
                H.index_add_(0, index[:, i] * k + index[:, j], (weight[:, i] * weight[:, j])[:, None] * JJ)
    return H.reshape(k, k, 3, 3).transpose(1, 2).reshape(3 * k, 3 * k), b.flatten()


def _rigidity(body: SoftBody, u: Float[Tensor, "k 3"]) -> tuple[Float[Tensor, "m m"], Float[Tensor, "m"]]:
    """Normal equations of the as-rigid-as-possible term."""
    i, j = body.edges.unbind(1)
    k, rest = len(u), body.nodes[body.edges[:, 1]] - body.nodes[body.edges[:, 0]]
    now = rest + u[j] - u[i]
    cross = rest.new_zeros(k, 3, 3).index_add_(0, i, now[:, :, None] * rest[:, None])
    off = (nearest_rotation(cross)[i] @ rest[..., None])[..., 0] - now
    weight = (PIXEL_NOISE / (STRETCH * rest.norm(dim=1).clamp_min(1e-9))) ** 2
    L = torch.zeros(k, k).to(u)
    for a, c, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
        L.index_put_((a, c), sign * weight, accumulate=True)
    b = torch.zeros_like(u).index_add_(0, j, weight[:, None] * off).index_add_(0, i, -weight[:, None] * off)
    return torch.kron(L, torch.eye(3).to(u)), b.flatten()


def followed(
    bodies: dict[int, tuple[SoftBody, Tensor]], row: Int[Tensor, "p"], arm: Float[Tensor, "p 3"]
) -> Iterator[Float[Tensor, "p 3"]]:
    """For each frame, the displacements of keypoints by soft bodies, in the rest frames of their objects."""
    frames = len(next(iter(bodies.values()))[1])
    out = torch.zeros(frames, *arm.shape)
    for i, (body, u) in bodies.items():
        out[:, row == i] = body.displaced(u, arm[row == i].to(u)).cpu()
    yield from out
