"""Rasterisation: analytic cases, comparison with a reference, and equality across devices."""

import gc
import weakref
from dataclasses import replace

import pytest
import torch

from stages.core.geometry.cameras import intrinsics, look_at
from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.kernels import interop
from stages.core.kernels.splat.binning import depth_order_reference
from stages.core.kernels.splat.compositing import composite_reference
from stages.core.kernels.splat.projection import pack_camera, project_reference
from stages.core.raster.rasterise import rasterise, rasterise_features, visibility
from stages.core.scene.gaussians import Gaussians
from tests.conftest import random_gaussians, ring

devices = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
EYE = look_at(torch.tensor([2.0, 0.0, 0.0]), torch.zeros(3))  # faces -x; right is +y, up is +z
SIZE, FOCAL = 41, 50.0  # an odd size, so that the optical axis passes through the centre of pixel (20, 20)
K = intrinsics(SIZE, SIZE, FOCAL)


def isotropic(*blobs: tuple, device: str = "cpu") -> Gaussians:
    """Isotropic Gaussians given as (mean, standard deviation, opacity, colour)."""
    means, sizes, opacities, colours = (torch.tensor(column, device=device) for column in zip(*blobs, strict=True))
    n = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(n, 1)
    ids = torch.zeros(n, dtype=torch.int64, device=device)
    return Gaussians(means, quats, sizes[:, None].repeat(1, 3), opacities, rgb_to_sh(colours), ids)


def draw(gaussians: Gaussians, *args, **options):
    return rasterise(gaussians, EYE[None], K[None], SIZE, SIZE, *args, **options)


def leaves(gaussians: Gaussians) -> list[torch.Tensor]:
    g = gaussians
    return [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]


def reference(tensors, viewmat, K, width: int, height: int):
    """Image, mean depth and alpha in float64, computed from all splats in every pixel."""
    splats = project_reference(pack_camera(viewmat, K, width, height, 0.01), *tensors)
    rgb, total, alpha, _ = composite_reference(splats, depth_order_reference(splats), width, height)
    return rgb, alpha, total / alpha.clamp_min(1e-10)


@pytest.mark.parametrize("device", devices)
def test_single_gaussian_equals_the_analytic_image(device):
    # Standard deviation 0.1 at distance 2: variance (0.1 * 50 / 2)^2 + 0.3 = 6.55 px^2.
    shot = draw(isotropic(((0.0, 0.0, 0.0), 0.1, 0.8, (1.0, 0.5, 0.25)), device=device))
    centre = shot.rgb[0, 20, 20].cpu()
    torch.testing.assert_close(centre, 0.8 * torch.tensor([1.0, 0.5, 0.25]), rtol=0, atol=1e-5)
    assert float(shot.alpha[0, 20, 20]) == pytest.approx(0.8, abs=1e-5)
    assert float(shot.depth[0, 20, 20]) == pytest.approx(2.0, abs=1e-5)
    fall = 0.8 * torch.exp(torch.tensor(-0.5 * 9 / 6.55))
    for row, column in ((20, 23), (23, 20), (20, 17), (17, 20)):
        assert float(shot.alpha[0, row, column]) == pytest.approx(float(fall), abs=1e-5)
    # alpha falls below 1/255 at sqrt(2 ln(255 * 0.8) * 6.55) = 8.35 px
    assert shot.alpha[0, 20, 28] > 0 and shot.alpha[0, 20, 29] == 0 and shot.depth[0, 0, 0] == 0
    assert bool(shot.visible.all()) and float(shot.extents[0, 0, 0]) == pytest.approx(8.35, abs=0.7)


@pytest.mark.parametrize("device", devices)
def test_image_axes_point_right_and_down(device):
    shot = draw(isotropic(((0.0, 0.4, 0.2), 0.05, 0.9, (1.0, 1.0, 1.0)), device=device))
    row, column = divmod(int(shot.alpha[0].argmax()), SIZE)
    assert (row, column) == (20 - 5, 20 + 10)  # 50 px * 0.2 / 2 up, 50 * 0.4 / 2 to the right


@pytest.mark.parametrize("device", devices)
def test_near_gaussians_occlude_far_ones_in_any_order(device):
    red, green = ((0.5, 0.0, 0.0), 0.3, 0.9, (1.0, 0.0, 0.0)), ((-0.5, 0.0, 0.0), 0.3, 0.9, (0.0, 1.0, 0.0))
    for blobs in ((red, green), (green, red)):
        shot = draw(isotropic(*blobs, device=device))
        wanted = torch.tensor([0.9, 0.1 * 0.9, 0.0])
        torch.testing.assert_close(shot.rgb[0, 20, 20].cpu(), wanted, rtol=0, atol=1e-5)
        assert float(shot.depth[0, 20, 20]) == pytest.approx((0.9 * 1.5 + 0.09 * 2.5) / 0.99, abs=1e-4)


@pytest.mark.parametrize("device", devices)
def test_background_fills_the_remaining_transmittance(device):
    spot = isotropic(((0.0, 0.0, 0.0), 0.1, 0.8, (1.0, 0.0, 0.0)), device=device)
    blue = torch.tensor([0.0, 0.25, 0.5])
    shot = draw(spot, blue.to(device))
    torch.testing.assert_close(shot.rgb[0, 0, 0].cpu(), blue)
    torch.testing.assert_close(shot.rgb[0, 20, 20].cpu(), torch.tensor([0.8, 0.05, 0.1]), rtol=0, atol=1e-5)
    picture = torch.rand(SIZE, SIZE, 3)
    shot, plain = draw(spot, picture), draw(spot)
    wanted = plain.rgb[0].cpu() + (1 - plain.alpha[0].cpu())[..., None] * picture
    torch.testing.assert_close(shot.rgb[0].cpu(), wanted, rtol=0, atol=1e-6)
    assert torch.equal(shot.alpha, plain.alpha)


@pytest.mark.parametrize("device", devices)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [(45, 67), (64, 32), (7, 3)], ids=str)
def test_images_equal_the_reference(device, degree, size):
    gaussians, cameras = random_gaussians(150, seed=degree, degree=degree), ring(3, size=max(size))
    shot = rasterise(gaussians.to(device), cameras.viewmats, cameras.Ks, *size)
    tensors = [t.detach().double() for t in leaves(gaussians)]
    assert shot.rgb.shape == (3, size[1], size[0], 3)
    for i in range(3):
        rgb, alpha, depth = reference(tensors, cameras.viewmats[i], cameras.Ks[i], *size)
        torch.testing.assert_close(shot.rgb[i].double().cpu(), rgb, rtol=0, atol=1e-4)
        torch.testing.assert_close(shot.alpha[i].double().cpu(), alpha, rtol=0, atol=1e-4)
        torch.testing.assert_close(shot.depth[i].double().cpu(), depth, rtol=1e-3, atol=1e-3)
    assert shot.alpha.max() > 0.8


@pytest.mark.parametrize("device", devices)
@pytest.mark.parametrize("degree", [0, 3])
def test_gradients_equal_the_reference(device, degree):
    gaussians, cameras = random_gaussians(120, seed=7, degree=degree), ring(2, size=48)
    ours, exact = leaves(gaussians.to(device)), [t.detach().double().requires_grad_() for t in leaves(gaussians)]
    rng = torch.Generator().manual_seed(1)
    wr, wa, wd = (torch.randn(2, 48, 48, *rest, generator=rng) for rest in ((3,), (), ()))
    grey = torch.full((3,), 0.4)
    shot = rasterise(Gaussians(*ours, gaussians.object_id), cameras.viewmats, cameras.Ks, 48, 48, grey.to(device))
    loss = (shot.rgb.cpu() * wr).sum() + (shot.alpha.cpu() * wa).sum() + (shot.depth.cpu() * wd).sum()
    total = 0
    for i in range(2):
        rgb, alpha, depth = reference(exact, cameras.viewmats[i], cameras.Ks[i], 48, 48)
        total = total + ((rgb + (1 - alpha)[..., None] * grey) * wr[i]).sum() + (alpha * wa[i] + depth * wd[i]).sum()
    mine, true = torch.autograd.grad(loss, ours), torch.autograd.grad(total, exact)
    for name, a, b in zip(("means", "quats", "scales", "opacities", "sh"), mine, true, strict=True):
        assert float((a.double().cpu() - b).norm() / b.norm()) < (1e-4 if device == "cpu" else 1e-3), name


@pytest.mark.gpu
def test_gsplat_agrees_on_a_large_scene():
    """50,000 Gaussians at 448 px: images agree to at least 45 dB, gradients to 1e-3 of their length."""
    gsplat = pytest.importorskip("gsplat")
    gaussians, cameras = random_gaussians(50_000, seed=3, degree=2, size=0.02).to("cuda"), ring(1, size=448)

    def theirs(means, quats, scales, opacities, sh):
        image, _, _ = gsplat.rasterization(
            means, quats, scales, opacities, sh, cameras.viewmats.cuda(), cameras.Ks.cuda(), 448, 448, sh_degree=2,
            near_plane=0.01, packed=False, render_mode="RGB+ED",
        )  # fmt: skip
        return image[..., :3], image[..., 3]

    def ours(*tensors):
        shot = rasterise(Gaussians(*tensors, gaussians.object_id), cameras.viewmats, cameras.Ks, 448, 448)
        return shot.rgb, shot.depth

    results = []
    for draw_with in (ours, theirs):
        tensors = leaves(gaussians)
        rgb, depth = draw_with(*tensors)
        weight = torch.randn(rgb.shape, generator=torch.Generator().manual_seed(0)).cuda()
        results.append((rgb.detach(), torch.autograd.grad((rgb * weight).sum() + depth.sum(), tensors)))
    (image, mine), (peer, true) = results
    assert 10 * float(torch.log10(1 / (image - peer).square().mean())) >= 45
    for name, a, b in zip(("means", "quats", "scales", "opacities", "sh"), mine, true, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-3, name


@pytest.mark.gpu
def test_a_gpu_draws_where_no_kernel_can_be_compiled_for_the_cpu(monkeypatch):
    g, cameras = random_gaussians(300, seed=1), ring(1, 48)
    view, one = (cameras.viewmats, cameras.Ks, 48, 48), (cameras.viewmats[0], cameras.Ks[0], 48, 48)
    weight = torch.randn(1, 48, 48, 3, generator=torch.Generator().manual_seed(0))

    def drawn(home):
        leaf = g.means.clone().to(home).requires_grad_()
        shot = rasterise(replace(g.to(home), means=leaf), *view, torch.ones(3, device=home))
        (shot.rgb * weight.to(home)).sum().backward()
        features = rasterise_features(g.to(home), g.scales.to(home), *view)
        return shot.rgb.detach(), leaf.grad, features, shot.absgrad, *visibility(g.to(home), *one)[3:]

    expected = drawn("cuda")
    monkeypatch.setattr(interop, "compiles_for_cpu", lambda: False)
    for ours, theirs in zip(drawn("cpu"), expected, strict=True):
        assert ours.device.type == "cpu" and torch.equal(ours, theirs.cpu())


@pytest.mark.parametrize("device", devices)
def test_gradient_descent_recovers_a_gaussian(device):
    wanted = draw(isotropic(((0.0, 0.1, -0.05), 0.15, 0.7, (0.9, 0.4, 0.2)), device=device)).rgb.detach()
    start = leaves(isotropic(((0.0, -0.1, 0.1), 0.2, 0.5, (0.5, 0.5, 0.5)), device=device))
    optimiser = torch.optim.Adam(start, lr=0.01)
    losses = []
    for _ in range(160):
        shot = draw(Gaussians(*start, torch.zeros(1, dtype=torch.int64, device=device)))
        losses.append((shot.rgb - wanted).square().mean())
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert losses[-1] < 1e-3 * losses[0]
    x, y, z = start[0][0].tolist()  # one view fixes the direction, not the distance
    assert y / (2 - x) == pytest.approx(0.05, abs=2e-3) and z / (2 - x) == pytest.approx(-0.025, abs=2e-3)


@pytest.mark.parametrize("device", devices)
def test_invisible_gaussians_have_no_effect(device):
    seen = random_gaussians(30, degree=1)
    hidden = random_gaussians(4, seed=1, degree=1)
    # behind the camera, at the camera, outside the image, and nearer than NEAR
    hidden.means[:] = torch.tensor([[5.0, 0, 0], [2.0, 0, 0], [0, 30, 0], [1.995, 0, 0]])
    both = Gaussians(*(torch.cat([getattr(seen, f), getattr(hidden, f)]) for f in vars(seen)))
    tensors = leaves(both.to(device))
    shot, plain = draw(Gaussians(*tensors, both.object_id.to(device))), draw(seen.to(device))
    assert torch.equal(shot.rgb.detach(), plain.rgb) and shot.rgb.isfinite().all()
    assert not shot.visible[0, 30:].any() and shot.visible[0, :30].all()
    for grad in torch.autograd.grad(shot.rgb.sum() + shot.depth.sum(), tensors):
        assert grad.isfinite().all() and (grad[30:] == 0).all()


def test_empty_scene_shows_the_background():
    none = random_gaussians(5)[torch.zeros(5, dtype=torch.bool)]
    shot = draw(none, torch.tensor([0.1, 0.2, 0.3]))
    assert (shot.rgb == torch.tensor([0.1, 0.2, 0.3])).all() and (shot.alpha == 0).all() and (shot.depth == 0).all()
    *_, index, weight = visibility(none, EYE, K, SIZE, SIZE)
    assert (index == -1).all() and weight.shape == (0,)
    assert rasterise_features(none, torch.zeros(0, 2), EYE[None], K[None], SIZE, SIZE).shape == (1, SIZE, SIZE, 2)


@pytest.mark.parametrize("device", devices)
@pytest.mark.parametrize("count", [1, 3, 4, 7])
def test_features_are_composited_like_colours(device, count):
    gaussians, cameras = random_gaussians(200, degree=0).to(device), ring(2, size=48)
    colours = torch.rand(200, count, generator=torch.Generator().manual_seed(1)).to(device).requires_grad_()
    image = rasterise_features(gaussians, colours, cameras.viewmats, cameras.Ks, 48, 40)
    assert image.shape == (2, 40, 48, count)
    for channel in range(count):
        grey = colours[:, channel : channel + 1].detach().expand(-1, 3)
        shot = rasterise(replace(gaussians, sh=rgb_to_sh(grey)), cameras.viewmats, cameras.Ks, 48, 40)
        torch.testing.assert_close(image[..., channel].detach(), shot.rgb[..., 0], rtol=0, atol=1e-5)
    with torch.no_grad():  # bins in which four features are all zero are skipped
        few = colours * (torch.arange(200) < 5)[:, None].to(device)
        shown = rasterise_features(gaussians, few, cameras.viewmats, cameras.Ks, 48, 40)
    all_bins = rasterise_features(gaussians, few.requires_grad_(), cameras.viewmats, cameras.Ks, 48, 40)
    assert torch.equal(shown, all_bins) and (shown > 0).any() and (shown == 0).any()
    # the derivative with respect to a feature is the total weight of the Gaussian
    (grad,) = torch.autograd.grad(image.sum(), colours)
    weights = sum(visibility(gaussians, V, K, 48, 40).weight for V, K in zip(cameras.viewmats, cameras.Ks, strict=True))
    torch.testing.assert_close(grad[:, -1], weights, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("device", devices)
def test_visibility_has_the_images_of_rasterise(device):
    gaussians = random_gaussians(300).to(device)
    rgb, alpha, depth, *_ = visibility(gaussians, EYE, K, SIZE, SIZE)
    shot = draw(gaussians)
    for found, separate in ((rgb, shot.rgb[0]), (alpha, shot.alpha[0]), (depth, shot.depth[0])):
        torch.testing.assert_close(found, separate)


@pytest.mark.parametrize("device", devices)
def test_visibility_weights_sum_to_alpha(device):
    gaussians = random_gaussians(300).to(device)
    *_, index, weight = visibility(gaussians, EYE, K, SIZE, SIZE)
    alpha = draw(gaussians).alpha[0]
    assert float(weight.sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)
    assert torch.equal(index >= 0, alpha > 0)
    red, green = ((0.5, 0.0, 0.0), 0.1, 0.9, (1.0, 0.0, 0.0)), ((-0.5, 0.0, 0.0), 0.3, 0.9, (0.0, 1.0, 0.0))
    *_, index, weight = visibility(isotropic(green, red, device=device), EYE, K, SIZE, SIZE)
    assert index[20, 20] == 1 and index[20, 30] == 0 and index[0, 0] == -1 and (weight > 0).all()


@pytest.mark.parametrize("device", devices)
def test_absolute_gradients_are_available_after_backward(device):
    gaussians, cameras = random_gaussians(50).to(device), ring(2, size=48)
    tensors = leaves(gaussians)
    shot = rasterise(Gaussians(*tensors, gaussians.object_id), cameras.viewmats, cameras.Ks, 48, 48)
    assert (shot.absgrad == 0).all()
    shot.rgb.square().sum().backward()
    assert shot.absgrad.shape == (2, 50, 2) and (shot.absgrad[shot.visible] > 0).any()
    assert (shot.absgrad[~shot.visible] == 0).all()


@pytest.mark.parametrize("device", devices)
def test_autograd_graph_is_freed_after_a_step(device):
    """Otherwise memory grows with the number of optimisation steps."""
    gaussians, cameras = random_gaussians(50).to(device), ring(1, size=48)
    tensors = leaves(gaussians)
    gc.disable()  # so that reference cycles are not collected
    try:
        moved = tensors[0] + 1e-3
        mark = moved.grad_fn.metadata["mark"] = set()
        kept = weakref.ref(mark)
        shot = rasterise(Gaussians(moved, *tensors[1:], gaussians.object_id), cameras.viewmats, cameras.Ks, 48, 48)
        shot.rgb.square().sum().backward()
        assert kept() is not None
        del mark, moved, shot
        assert kept() is None
    finally:
        gc.enable()


def test_repeated_rendering_is_bit_identical(device):
    gaussians, cameras = random_gaussians(1000, degree=2).to(device), ring(1, size=112)
    results = []
    for _ in range(2):
        tensors = leaves(gaussians)
        shot = rasterise(Gaussians(*tensors, gaussians.object_id), cameras.viewmats, cameras.Ks, 112, 112)
        results.append((shot.rgb.detach(), *torch.autograd.grad(shot.rgb.square().sum(), tensors)))
    for first, second in zip(*results, strict=True):
        assert torch.equal(first, second)


def test_incomplete_harmonics_raise():
    gaussians = random_gaussians(5, degree=1)
    with pytest.raises(ValueError, match="not a full set"):
        draw(replace(gaussians, sh=gaussians.sh[:, :3]))
