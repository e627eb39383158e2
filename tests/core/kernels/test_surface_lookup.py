"""Closest points on bodies: convex ones compared with projection by non-negative least squares, a torus analytically.

Source: least distance programming, Lawson and Hanson 1974, "Solving Least Squares Problems", chapter 23.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from scipy.optimize import nnls
from torch import Tensor

from stages.core.kernels.field.surface_lookup import SurfaceArrays, closest_point, first_inside
from stages.core.kernels.interop import launch, view, with_arrays
from stages.core.models.field.body_surfaces import BodyGrid, BodySurfaces


@wp.kernel(enable_backward=False)
def _closest(s: SurfaceArrays, x: wp.array[wp.vec3], at: wp.array[wp.vec3], normal: wp.array[wp.vec3]):
    i = wp.tid()
    found = closest_point(s, 0, x[i], wp.vec3(), wp.vec3())
    at[i] = found.at
    normal[i] = found.normal


def closest(surface: BodyGrid, x: Tensor, device: str) -> tuple[Tensor, Tensor]:
    """Closest points and the normals there, on the CPU."""
    surfaces = BodySurfaces.of([surface]).to(device)
    x = x.to(device)
    at, normal = torch.empty_like(x), torch.empty_like(x)
    arrays = with_arrays(SurfaceArrays(), vars(surfaces))
    launch(_closest, len(x), [arrays, *(view(a, wp.vec3) for a in (x, at, normal))], device=device)
    return at.cpu(), normal.cpu()


def grid_of(depth: Tensor, low: Tensor, spacing: float, samples: Tensor, hull: Tensor) -> BodyGrid:
    """A body with these depths and surface samples."""
    rows, row = torch.zeros(depth.shape, dtype=torch.long), torch.zeros(len(samples), dtype=torch.long)
    return BodyGrid(depth, depth, rows, low, spacing, samples, samples, row, row, torch.ones(1), torch.zeros(1, 3, 3),
                    rows, hull=hull)  # fmt: skip


def projected(normals: np.ndarray, offsets: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The point with normals @ point + offsets <= 0 that is closest to x."""
    G, h = -normals, normals @ x + offsets
    E = np.vstack([G.T, h])
    residual = E @ nnls(E, np.array([0.0, 0, 0, 1]))[0] - np.array([0.0, 0, 0, 1])
    return x - residual[:3] / residual[3]


def test_of_a_polyhedron(device):
    """Random facets, a cube, and a prism with many sides, whose planes meet in narrow wedges."""
    rng = np.random.default_rng(0)
    sides = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    prism = np.concatenate([np.stack([np.cos(sides), np.sin(sides), 0 * sides], 1), [[0, 0, 1], [0, 0, -1]]])
    cube = np.concatenate([np.eye(3), -np.eye(3)])
    for normals in (rng.normal(size=(40, 3)), cube, prism):
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = -np.ones(len(normals))
        x = rng.normal(size=(300, 3))
        x *= rng.uniform(1.0, 4.0, (300, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
        x = x[(x @ normals.T + offsets).max(1) > 0.01]
        planes = torch.from_numpy(np.concatenate([normals, offsets[:, None]], 1)).float()
        body = grid_of(torch.zeros(2, 2, 2), -torch.ones(3), 2.0, torch.eye(3), planes)
        at, _ = closest(body, torch.from_numpy(x).float(), device)
        expected = np.array([projected(normals, offsets, point) for point in x])
        assert np.abs(at.numpy() - expected).max() < 1e-4
        inside = torch.from_numpy(rng.uniform(-0.5, 0.5, (50, 3))).float()
        at, normal = closest(body, inside, device)
        beyond = inside.double().numpy() @ normals.T + offsets
        assert np.allclose((at - inside).norm(dim=1), -beyond.max(1), atol=1e-5)
        assert np.allclose(normal, normals[beyond.argmax(1)], atol=1e-6)


def test_of_a_torus_on_a_grid(device):
    """Points are outside or in the hole. Grid gradients have an error of half the spacing over the curvature radius."""
    spacing, ring, tube = 0.02, 0.5, 0.2
    low = torch.tensor([-0.8, -0.8, -0.3])
    nodes = torch.stack(torch.meshgrid(*(torch.arange(n) for n in (81, 81, 31)), indexing="ij"), -1)
    x = low + spacing * nodes

    def depth(x: Tensor) -> Tensor:
        return tube - torch.stack([x[..., :2].norm(dim=-1) - ring, x[..., 2]], -1).norm(dim=-1)

    def points(count: int) -> tuple[Tensor, Tensor]:
        around, along = 2 * torch.pi * torch.rand(2, count, generator=generator)
        radial = torch.stack([around.cos(), around.sin(), torch.zeros(count)], 1)
        normals = along.cos()[:, None] * radial + along.sin()[:, None] * torch.eye(3)[2]
        return ring * radial + tube * normals, normals

    generator = torch.Generator().manual_seed(0)
    body = grid_of(depth(x), low, spacing, points(512)[0], torch.zeros(0, 4))
    surface, normals = points(500)
    for distance in (0.05, 0.1, 0.2):
        x = surface + distance * normals
        at, _ = closest(body, x, device)
        assert depth(at).abs().max() < 0.1 * spacing
        assert ((x - at).norm(dim=1) - distance).abs().max() < 0.1 * spacing
        assert (torch.nn.functional.normalize(x - at, dim=1) - normals).norm(dim=1).max() < 2 * spacing / tube


@wp.kernel(enable_backward=False)
def _first_inside(s: SurfaceArrays, x: wp.array[wp.vec3], way: wp.array[wp.vec3], outside: float, out: wp.array[float]):
    i = wp.tid()
    out[i] = first_inside(s, 0, x[i], way[i], outside)


def test_a_way_meets_the_near_side_of_a_wall_of_three_nodes(device):
    """From both sides, through the wall or into it, for points and for a ball; accurate to one node along the path."""
    spacing, half, outside = 0.02, 0.03, 0.05
    low, shape = torch.tensor([-0.2, -0.5, -0.5]), (21, 51, 51)
    depth = half - (low[0] + spacing * torch.arange(shape[0])).abs()[:, None, None].expand(shape).contiguous()
    body = grid_of(depth, low, spacing, torch.eye(3), torch.zeros(0, 4))
    surfaces = with_arrays(SurfaceArrays(), vars(BodySurfaces.of([body]).to(device)))
    generator = torch.Generator().manual_seed(0)
    side = torch.tensor([-1.0, 1.0]).repeat(100)
    x = torch.stack([0.15 * side, *(0.4 * torch.rand(2, 200, generator=generator) - 0.2)], 1)
    u, v, w = torch.rand(3, 200, generator=generator)
    way = torch.stack([-side * (0.2 + u), 0.4 * v, 0.4 * w], 1)  # at angles of up to 71 degrees
    for radius in (0.0, outside):
        found, away = (torch.empty(200, device=device) for _ in range(2))
        for ways, out in ((way, found), (-way, away)):
            arrays = [view(a.to(device), wp.vec3) for a in (x, ways)]
            launch(_first_inside, 200, [surfaces, *arrays, radius, view(out)], device=device)
        beyond = found.cpu() - (0.15 - half - radius) / way[:, 0].abs()
        assert float(beyond.min()) > -1e-5 and float((beyond * way.norm(dim=1)).max()) < spacing + 1e-5
        assert bool((away == 1).all())
        arrays = [view(a.to(device), wp.vec3) for a in (x, 0.05 * way)]  # the path ends before the wall
        launch(_first_inside, 200, [surfaces, *arrays, radius, view(found)], device=device)
        assert bool((found == 1).all())
