"""The kernels of the rasteriser (projection, binning, compositing), compared with their references."""

import pytest
import torch

from stages.core.kernels.simd import even_bounds
from stages.core.kernels.splat.binning import bin_splats, depth_order_reference
from stages.core.kernels.splat.compositing import composite, composite_reference, composite_with_dominant
from stages.core.kernels.splat.projection import BIN_SIZE, TILE_SIZE, pack_camera, project, project_reference
from stages.core.kernels.splat.tiles import Capacity, bin_tiles
from tests.conftest import random_gaussians, ring

WIDTH, HEIGHT = 71, 53  # not multiples of block, bin or lane counts


def view_of(gaussians, closer: float = 0.0, size=(WIDTH, HEIGHT)):
    """A packed camera 2 m from the origin, or `closer` [m], and the tensors of the Gaussians."""
    cameras = ring()
    viewmat = cameras.viewmats[1].clone()
    viewmat[2, 3] -= closer
    camera = pack_camera(viewmat, cameras.Ks[1], *size, 0.01)
    return camera, (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)


def random_splats(n: int, opacity: float = 1.0, seed: int = 0, size=(WIDTH, HEIGHT), device: str = "cpu"):
    gaussians = random_gaussians(n, seed=seed, degree=1)
    camera, tensors = view_of(gaussians, size=size)
    tensors = (*tensors[:3], (opacity * tensors[3]).clamp(max=1.0), tensors[4])
    with torch.no_grad():
        splats, keys, rects = project(camera.to(device), *(t.to(device) for t in tensors))
    return splats, (bin_tiles if device == "cuda" else bin_splats)(keys, rects, *size)


def relative(ours, theirs) -> float:
    return float((ours.double() - theirs.double()).norm() / theirs.double().norm())


@pytest.mark.parametrize("closer", [0.0, 1.7], ids=["outside", "inside the cloud"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_projection_equals_its_reference(degree, closer, device):
    # inside the cloud, large Gaussians centred far outside the image overlap it: their Jacobian is clamped
    camera, tensors = view_of(random_gaussians(203, degree=degree, size=0.25 if closer else 0.05), closer)
    tensors = [t.clone().requires_grad_() for t in tensors]
    exact = [t.detach().double().requires_grad_() for t in tensors]
    splats = project(camera.to(device), *(t.to(device) for t in tensors))[0].cpu()
    theirs = project_reference(camera, *exact)
    assert torch.equal(splats[:, 11] > 0, theirs[:, 11] > 0)
    assert 20 < (splats[:, 11] > 0).sum() <= 203
    torch.testing.assert_close(splats[:, :10].double(), theirs[:, :10], rtol=1e-4, atol=1e-5)
    # extents have a small margin and are never too small
    assert (splats[:, 11:13] >= theirs[:, 11:13] - 1e-4).all()
    torch.testing.assert_close(splats[:, 11:13].double(), theirs[:, 11:13], rtol=2e-3, atol=2e-2)
    weight = torch.randn(splats.shape, generator=torch.Generator().manual_seed(1))
    # separately, since the gradient of the centre is much larger than that of the covariance
    for columns in (slice(0, 2), slice(2, 5), slice(5, 10)):
        value, exact_value = ((s[:, columns] * weight[:, columns]).sum() for s in (splats, theirs))
        ours = torch.autograd.grad(value, tensors, retain_graph=True)
        wanted = torch.autograd.grad(exact_value, exact, retain_graph=True, allow_unused=True)
        for name, mine, true in zip(("means", "quats", "scales", "opacities", "sh"), ours, wanted, strict=True):
            true = torch.zeros_like(mine) if true is None else true
            size = float(true.norm())
            assert float((mine - true).norm()) <= 1e-5 * size, name
            torch.testing.assert_close(mine.double(), true.double(), rtol=1e-4, atol=1e-5 * size)


def test_quaternion_norm_has_no_effect():
    camera, (means, quats, *rest) = view_of(random_gaussians(40))
    torch.testing.assert_close(project(camera, means, 7 * quats, *rest)[0], project(camera, means, quats, *rest)[0])


def test_gaussians_outside_the_view_or_nan_are_not_visible():
    gaussians = random_gaussians(6)
    eye = -ring().viewmats[1][:3, :3].T @ ring().viewmats[1][:3, 3]
    gaussians.means[0] = 2 * eye  # behind the camera
    gaussians.means[1] = eye  # at the camera centre
    gaussians.means[2] = torch.tensor([0.0, 0.0, 50.0])  # above the image
    gaussians.means[3] = float("nan")
    gaussians.opacities[4] = 0.9 / 255  # below the minimum alpha
    gaussians.means[5] = 0.0
    camera, tensors = view_of(gaussians)
    tensors = [t.requires_grad_() for t in tensors]
    splats, keys, _ = project(camera, *tensors)
    assert (splats[:, 11] > 0).tolist() == [False] * 5 + [True]
    assert splats.isfinite().all() and (keys[:5] == -1).all()
    for grad in torch.autograd.grad(splats.sum(), tensors):
        assert grad.isfinite().all() and (grad[:5] == 0).all()


@pytest.mark.parametrize("n", [0, 1, 17, 1500])
def test_bins_hold_overlapping_splats_nearest_first(n):
    splats, bins = random_splats(n)
    order = depth_order_reference(splats)
    across = -(-WIDTH // BIN_SIZE)
    assert len(bins.starts) == across * -(-HEIGHT // BIN_SIZE) + 1 and bins.starts[-1] == len(bins.members)
    low, high = splats[order, :2] - splats[order, 11:13], splats[order, :2] + splats[order, 11:13]
    for b in range(len(bins.starts) - 1):
        corner = torch.tensor([b % across, b // across]) * BIN_SIZE
        # contains a pixel centre of the bin
        touches = ((low <= corner + BIN_SIZE - 0.5) & (high >= corner + 0.5)).all(1)
        members = bins.members[bins.starts[b] : bins.starts[b + 1]]
        assert set(order[touches].tolist()) <= set(members.tolist())
        assert torch.equal(members.long(), order[torch.isin(order, members)])


def test_equal_depths_keep_the_input_order():
    keys = torch.tensor([5, 7, 5, -1, 7, 5, 1 << 30], dtype=torch.int32)
    bins = bin_splats(keys, torch.zeros(7, 4, dtype=torch.int16), 20, 20)
    assert bins.members.tolist() == [0, 2, 5, 1, 4, 6]


def test_balanced_bounds_cover_all_bins():
    _, bins = random_splats(1500, size=(320, 200))
    bounds = bins.balanced_bounds(3)
    assert bounds[0] == 0 and bounds[-1] == len(bins.starts) - 1 and bounds == sorted(set(bounds))
    assert even_bounds(10, 3) == [0, 3, 6, 10]


# with opacity 3, most splats are clamped to alpha 0.999 and many pixels finish early
@pytest.mark.parametrize("opacity", [0.1, 1.0, 3.0])
def test_compositing_equals_its_reference(opacity, device):
    splats, bins = random_splats(400, opacity, device=device)
    splats.requires_grad_()
    exact = splats.detach().double().cpu().requires_grad_()
    *theirs, _ = composite_reference(exact, depth_order_reference(exact), WIDTH, HEIGHT)
    ours = [image.cpu() for image in composite(splats, bins)]
    assert 0.05 < ours[2].mean() < 0.9 and (opacity == 0.1 or ours[2].max() > 0.999)
    for mine, true in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine.double(), true, rtol=0, atol=5e-6)
    weights = [torch.randn(image.shape, generator=torch.Generator().manual_seed(1)) for image in ours]
    (mine,) = torch.autograd.grad(sum((w * i).sum() for w, i in zip(weights, ours, strict=True)), splats)
    mine = mine.cpu()
    (true,) = torch.autograd.grad(sum((w.double() * i).sum() for w, i in zip(weights, theirs, strict=True)), exact)
    for column in range(10):
        assert relative(mine[:, column], true[:, column]) < 1e-5, column
    mine, true = mine[:, :10].double(), true[:, :10]
    torch.testing.assert_close(mine, true, rtol=1e-4, atol=1e-5 * float(true.abs().max()))


def test_gradient_includes_mean_and_background(device):
    splats, bins = random_splats(200, device=device)
    splats.requires_grad_()
    exact = splats.detach().double().cpu().requires_grad_()
    behind = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(2))
    rgb, mean = (image.cpu() for image in composite(splats, bins, behind.to(device), mean=True)[:2])
    colour, fourth, alpha, _ = composite_reference(exact, depth_order_reference(exact), WIDTH, HEIGHT)
    their_rgb, their_mean = colour + (1 - alpha)[..., None] * behind, fourth / alpha.clamp_min(1e-10)
    torch.testing.assert_close(rgb.double(), their_rgb, rtol=0, atol=5e-6)
    torch.testing.assert_close(mean.double(), their_mean, rtol=1e-4, atol=1e-5)
    (mine,) = torch.autograd.grad(rgb.square().sum() + mean.square().sum(), splats)
    (true,) = torch.autograd.grad(their_rgb.square().sum() + their_mean.square().sum(), exact)
    assert relative(mine[:, :10].cpu(), true[:, :10]) < 1e-4


def test_absolute_gradients_do_not_cancel(device):
    # A uniform upstream gradient is odd in x about the splat's centre: signed terms cancel, absolute ones add up.
    splats, bins = one_splat(40.5, 20.5, device)
    splats.requires_grad_()
    upstream = torch.ones(HEIGHT, WIDTH, 3, device=device)
    grad = torch.autograd.grad(composite(splats, bins)[0], splats, upstream)[0].cpu()
    sigma, x = 3.0, torch.arange(-40, 31).float()
    profile = 0.5 * torch.exp(-0.5 * (x / sigma) ** 2) * x / sigma**2
    y = torch.arange(-20, 33).float()
    both = (profile[None] * torch.exp(-0.5 * (y / sigma) ** 2)[:, None]).abs() * 3
    seen = (0.5 * torch.exp(-0.5 * (x**2 + y[:, None] ** 2) / sigma**2)) >= 1 / 255
    assert abs(float(grad[0, 0])) < 1e-4
    torch.testing.assert_close(grad[0, 10], both[seen].sum(), rtol=1e-4, atol=0)


def one_splat(x: float, y: float, device: str, opacity: float = 0.5, sigma: float = 3.0):
    splats = torch.zeros(1, 16)
    radius = sigma * (2 * torch.tensor(255 * opacity).log()).sqrt()
    conic = [1 / sigma**2, 0, 1 / sigma**2]
    splats[0, :13] = torch.tensor([x, y, *conic, opacity, 1, 1, 1, 2, torch.tensor(opacity).log2(), radius, radius])
    bins, last = (bin_tiles, (4, 3)) if device == "cuda" else (bin_splats, (2, 1))
    key, rect = torch.ones(1, dtype=torch.int32), torch.tensor([[0, 0, *last]], dtype=torch.int16)
    return splats.to(device), bins(key.to(device), rect.to(device), WIDTH, HEIGHT)


def test_dominant_splat_equals_the_reference(device):
    splats, bins = random_splats(400, device=device)
    exact = splats.double().cpu()
    order = depth_order_reference(exact)
    *_, weights = composite_reference(exact, order, WIDTH, HEIGHT)
    best = torch.where(weights.amax(-1) > 0, order[weights.argmax(-1)], -1)
    index, totals = (x.cpu() for x in composite_with_dominant(splats, bins)[3:])
    assert (index == best).float().mean() > 0.999 and (index == -1).any()
    torch.testing.assert_close(totals[order].double(), weights.sum((0, 1)), rtol=1e-4, atol=1e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("n", [1, 17, 1500])
def test_tiles_hold_overlapping_splats_nearest_first(n):
    splats, tiles = random_splats(n, device="cuda")
    order = depth_order_reference(splats.cpu())
    members = tiles.ids[tiles.slots].cpu().long()
    low, high = (splats[:, :2] - splats[:, 11:13]).cpu()[order], (splats[:, :2] + splats[:, 11:13]).cpu()[order]
    across = -(-WIDTH // TILE_SIZE)
    assert len(tiles.starts) == across * -(-HEIGHT // TILE_SIZE) + 1 and int(tiles.starts[-1]) == len(members)
    for b in range(len(tiles.starts) - 1):
        corner = torch.tensor([b % across, b // across]) * TILE_SIZE
        touches = ((low <= corner + TILE_SIZE - 0.5) & (high >= corner + 0.5)).all(1)
        listed = members[tiles.starts[b] : tiles.starts[b + 1]]
        assert set(order[touches].tolist()) <= set(listed.tolist())
        assert torch.equal(listed, order[torch.isin(order, listed)])


@pytest.mark.gpu
def test_capacity_changes_nothing_unless_it_is_too_small():
    gaussians = random_gaussians(1500, degree=1)
    camera, tensors = view_of(gaussians)
    splats, *keys = project(camera.cuda(), *(t.cuda() for t in tensors))
    splats = splats.detach().requires_grad_()
    exact = bin_tiles(*keys, WIDTH, HEIGHT)
    results = []
    for capacity in (None, Capacity.at_least(len(exact.slots), splats.device), Capacity.at_least(0, splats.device)):
        rgb, _, alpha = composite(splats, bin_tiles(*keys, WIDTH, HEIGHT, capacity))
        results.append([rgb, alpha, *torch.autograd.grad(rgb.square().sum() + alpha.sum(), splats)])
        assert capacity is None or int(capacity.needed) == len(exact.slots)
    whole, roomy, small = results
    assert all(torch.equal(a, b) for a, b in zip(whole, roomy, strict=True))
    assert small[0].isfinite().all() and small[2].isfinite().all() and not torch.equal(small[0], whole[0])


def test_results_do_not_depend_on_the_number_of_threads(request):
    before = torch.get_num_threads()
    request.addfinalizer(lambda: torch.set_num_threads(before))
    gaussians = random_gaussians(3000, degree=1)
    camera, tensors = view_of(gaussians, size=(200, 150))  # 7 x 5 bins
    leaves = [t.clone().requires_grad_() for t in tensors]
    results = []
    for threads in (1, 2, 4, 3, 2):
        torch.set_num_threads(threads)
        splats, keys, rects = project(camera, *leaves)
        bins = bin_splats(keys, rects, 200, 150)
        images = composite(splats, bins, mean=True)
        grads = torch.autograd.grad(sum(image.square().sum() for image in images), [splats, *leaves])
        results.append([bins.members, *images, *grads, *composite_with_dominant(splats.detach(), bins)[3:]])
    assert results[0][4].abs().sum() > 0 and len(results[0][0]) > 1.2 * 3000  # splats cover several bins
    for others in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], others, strict=True))


def test_slots_number_the_bins_of_each_splat_in_turn():
    splats, bins = random_splats(400, size=(200, 150))
    by_slot = bins.members[bins.slots.argsort()]
    assert torch.equal(bins.slots.sort().values, torch.arange(len(bins.members), dtype=torch.int32))
    assert torch.equal(by_slot.unique_consecutive(), depth_order_reference(splats).int())
