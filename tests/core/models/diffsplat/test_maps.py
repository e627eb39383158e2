"""Cameras, rays and Gaussian maps of DiffSplat, compared with independent formulas and projections."""

import math

import numpy as np
import pytest
import torch

from stages.core.geometry.cameras import centres, depths, intrinsics, project
from stages.core.geometry.harmonics import C0
from stages.core.models.diffsplat.maps import FOCAL, RADIUS, cameras, plucker, to_gaussians


def opengl_pose(elevation: float, azimuth: float) -> np.ndarray:
    """Camera-to-world matrix of kiui's orbit_camera, converted from OpenGL to OpenCV axes."""
    e, a = np.deg2rad(-elevation), np.deg2rad(azimuth)
    position = RADIUS * np.array([np.cos(e) * np.sin(a), -np.sin(e), np.cos(e) * np.cos(a)])
    back = position / np.linalg.norm(position)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], 1)
    return pose @ np.diag([1, -1, -1, 1])


@pytest.mark.parametrize("elevation", [-5.0, 0.0, 20.0])
def test_cameras_equal_the_published_orbit(elevation):
    expected = np.stack([np.linalg.inv(opengl_pose(elevation, azimuth)) for azimuth in (0, 90, 180, 270)])
    np.testing.assert_allclose(cameras(elevation).numpy(), expected, rtol=0, atol=1e-6)


def test_field_of_view_is_about_40_degrees():
    assert math.degrees(2 * math.atan(0.5 / FOCAL)) == pytest.approx(39.6, abs=0.05)


def test_rays_equal_the_published_formula():
    rays = plucker(cameras(20.0), 5)
    for view, azimuth in enumerate((0, 90, 180, 270)):
        pose = opengl_pose(20.0, azimuth)
        for row, column in ((0, 0), (1, 3), (4, 4)):
            # the public code: (x / (w - 1) + 0.5 - cx) / fx with cx = 0.5
            x, y = ((i / (5 - 1) + 0.5 - 0.5) / FOCAL for i in (column, row))
            direction = pose[:3, :3] @ [x, y, 1]
            direction /= np.linalg.norm(direction)
            expected = np.concatenate([np.cross(pose[:3, 3], direction), direction])
            np.testing.assert_allclose(rays[view, :, row, column].numpy(), expected, rtol=0, atol=1e-6)


def maps(side: int = 6, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(4, 12, side, side, generator=torch.Generator().manual_seed(seed)) - 1


def test_gaussians_project_to_their_pixels_at_the_given_depth():
    viewmats, inputs, side = cameras(15.0), maps(), 6
    g = to_gaussians(inputs, viewmats)
    assert len(g) == 4 * side * side
    for view in range(4):
        own = g.means[view * side**2 : (view + 1) * side**2]
        pixels = project(own, viewmats[view], intrinsics(side - 1, side - 1, FOCAL * (side - 1)))
        rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
        torch.testing.assert_close(pixels, torch.stack([columns, rows], -1).flatten(0, 1).float(), rtol=0, atol=1e-4)
        torch.testing.assert_close(depths(own, viewmats[view]), RADIUS + inputs[view, 11].flatten(), rtol=0, atol=1e-5)
    assert float(centres(viewmats).norm(dim=1).sub(RADIUS).abs().max()) < 1e-6


def test_channels_map_to_gaussian_parameters():
    inputs = torch.zeros(4, 12, 2, 2)
    inputs[:, :3] = torch.tensor([1.0, -1.0, 0.0])[:, None, None]  # red 1, green 0, blue 1/2
    inputs[:, 3:6] = torch.tensor([1.0, -1.0, 0.0])[:, None, None]  # maximum, minimum and mean scale
    inputs[:, 6:10] = torch.tensor([0.0, 0.0, 0.5, 0.0])[:, None, None]
    inputs[:, 10] = 0.5
    g = to_gaussians(inputs, cameras(0.0))
    torch.testing.assert_close(C0 * g.sh[0, 0] + 0.5, torch.tensor([1.0, 0.0, 0.5]))
    torch.testing.assert_close(g.scales[0], torch.tensor([0.0005, 0.02, 0.01025]))
    torch.testing.assert_close(g.quats[0], torch.tensor([0.0, 0.0, 1.0, 0.0]))
    assert float(g.opacities[0]) == pytest.approx(0.75)


def test_pixels_with_zero_opacity_are_dropped():
    inputs = maps()
    inputs[:, 10, :, :3] = -1
    assert len(to_gaussians(inputs, cameras(0.0))) == 4 * 6 * 3
