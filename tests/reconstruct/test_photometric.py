"""Photometric fit of Gaussians to photos."""

from dataclasses import replace

import pytest
import torch

from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.reconstruct import photometric
from stages.reconstruct.photometric import FitOptions
from stages.reconstruct.photos import Views
from tests.conftest import ball, random_gaussians, ring


def photographed(gaussians: Gaussians, cameras) -> Views:
    width, height = cameras.sizes[0].tolist()
    with torch.no_grad():
        images = rasterise(gaussians, cameras.viewmats, cameras.Ks, width, height, torch.zeros(3)).rgb
    return Views(tuple((image.clamp(0, 1) * 255).round().to(torch.uint8) for image in images), cameras)


@pytest.fixture(scope="module")
def target() -> tuple[Gaussians, Views]:
    inner = random_gaussians(300, seed=1)
    gaussians = concatenate([inner, ball((0.0, 0.0, 0.0), 4.0, 500, (0.3, 0.4, 0.5), 0)])  # covers every pixel
    return gaussians, photographed(gaussians, ring(6, 48))


def test_wrong_colours_are_corrected(target, device):
    true, views = target
    start = replace(true, sh=true.sh + 1)
    before, _ = photometric.score_views(start, views, list(range(6)), device)
    fitted = photometric.fit_gaussians(start, views, FitOptions(150, 2.0, device=device))
    after, _ = photometric.score_views(fitted, views, list(range(6)), device)
    assert after > before + 6


def test_the_same_seed_gives_the_same_gaussians(target, device):
    """Results are equal to the bit, including two splits."""
    true, views = target
    options = FitOptions(photometric.DENSITY.min_iterations, 2.0, seed=3, device=device)
    first, second = (photometric.fit_gaussians(true[:200], views, options) for _ in range(2))
    assert len(first) > 200
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


def test_the_number_of_threads_changes_nothing(target, with_threads):
    true, views = target
    first, second = (with_threads(n, photometric.fit_gaussians, true, views, FitOptions(8, 2.0)) for n in (1, 2))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


def test_activations_do_not_depend_on_the_number_of_threads(with_threads):
    """PyTorch distributes tensors of more than 32,768 numbers among its threads."""
    fit = photometric._Fit.start(random_gaussians(70_013), 3, 2.0)
    first, *others = (with_threads(n, fit.gaussians) for n in (1, 2, 3, 4))
    for other in others:
        assert torch.equal(first.scales, other.scales) and torch.equal(first.opacities, other.opacities)


@pytest.mark.gpu
def test_captured_steps_equal_single_steps(target):
    """Photos of two sizes, with depths, use two CUDA graphs."""
    true, views = target
    small, wide = photographed(true, ring(3, 48)), photographed(true, ring(3, 64))
    cameras = [torch.cat([getattr(v.cameras, name) for v in (small, wide)]) for name in ("viewmats", "Ks", "sizes")]
    both = Views(small.images + wide.images, replace(small.cameras, viewmats=cameras[0], Ks=cameras[1],
                 sizes=cameras[2], names=tuple(f"{i}.png" for i in range(6))))  # fmt: skip
    depths = [torch.full(image.shape[:2], 2.0) for image in both.images]
    start = replace(true, sh=true.sh + 0.3)
    cpu, cuda = (photometric.fit_gaussians(start, both, FitOptions(30, 2.0, device=d), depths) for d in ("cpu", "cuda"))
    assert len(cpu) == len(cuda)
    for name in ("means", "scales", "opacities", "sh"):
        assert float((getattr(cpu, name) - getattr(cuda, name)).abs().median()) < 1e-4, name
    before, mine, theirs = (photometric.score_views(g, both, list(range(6)))[0] for g in (start, cpu, cuda))
    assert abs(mine - before) > 1 and abs(mine - theirs) < 0.05


def test_scores_with_fitted_exposure(target, device):
    """Photos with 0.8 of the brightness lose more than 15 dB, which a fitted exposure recovers."""
    true, views = target
    dark = replace(views, images=tuple((0.8 * image.float()).round().to(torch.uint8) for image in views.images))
    exact, _ = photometric.score_views(true, views, [0, 1], device)
    raw, _ = photometric.score_views(true, dark, [0, 1], device)
    fitted, _ = photometric.score_views(true, dark, [0, 1], device, exposed=True)
    assert raw < 30 < 45 < fitted and exact > 45


def test_darker_photo_gets_lower_exposure(target, device):
    true, views = target
    images = list(views.images)
    images[0] = (images[0].float() * 0.6).to(torch.uint8)
    fit = photometric._Fit.start(true.to(device), len(views), 2.0)
    (group,) = photometric._targets(Views(tuple(images), views.cameras), (), 2.0, device)
    zero = torch.zeros(1, device=device)
    for _ in range(100):
        for view in (0, 3):
            photometric._descend(fit, group, photometric._Draw(torch.tensor([view], device=device), *[zero] * 4))
    gains = group.exposures @ fit.values["gains"].detach()
    assert float(gains[0].mean()) < float(gains[3].mean())


def test_scale_regularisation_shrinks_invisible_gaussians_only_in_size(target, device):
    """The last Gaussian is behind all cameras."""
    true, views = target
    unseen = replace(true[[0]], means=torch.tensor([[0.0, 0, 60.0]]))
    fit = photometric._Fit.start(concatenate([true, unseen]).to(device), len(views), 2.0)
    (group,) = photometric._targets(views, (), 2.0, device)
    zero, rate = torch.zeros(1, device=device), torch.tensor([1e-4], device=device)
    draw = photometric._Draw(torch.tensor([0], device=device), zero, rate, zero, zero)
    for _ in range(20):
        photometric._descend(fit, group, draw)
    after = fit.gaussians().to("cpu")
    assert (after.scales[-1] < 0.95 * unseen.scales).all()
    torch.testing.assert_close(after.opacities[-1:], unseen.opacities)


def test_what_is_left_out_of_a_step_is_a_random_share(target, device):
    """Omitted Gaussians have no gradient, and each is omitted in some step."""
    true, views = target
    fit = photometric._Fit.start(true.to(device), len(views), 2.0)
    (group,) = photometric._targets(views, (), 2.0, device)
    row, zero = torch.tensor([0], device=device), torch.zeros(1, device=device)

    def acts(dropout: float, lot: float) -> torch.Tensor:
        loss = photometric._loss(fit, group, photometric._Draw(row, zero, zero, zero + dropout, zero + lot), None)
        return torch.autograd.grad(loss, [fit.values["opacities"]])[0] != 0

    visible = acts(0.0, 0.0)
    left_out = torch.stack([visible & ~acts(0.25, lot) for lot in (0.0, 0.25, 0.5, 0.75)])
    assert int(visible.sum()) > 200 and bool(left_out.any(0)[visible].all())
    shares = left_out.sum(1) / visible.sum()
    assert float(shares.min()) > 0.15 and float(shares.max()) < 0.35


def test_exposure_excludes_parts_linear_in_the_camera_pose():
    """Brightness linear in the position is a view-dependent colour; a single darker photo is exposure."""
    cameras = ring(40, 48)
    projection = photometric._exposure_projection(cameras).double()
    torch.testing.assert_close(projection @ projection, projection)
    smooth = 0.3 * torch.linalg.inv(cameras.viewmats.double())[:, 0, 3] + 0.2
    assert float((projection @ smooth).abs().max()) < 1e-5
    dark = torch.zeros(40, dtype=torch.float64)
    dark[7] = -0.5
    left = projection @ dark
    assert float(left[7]) < -0.4 and float(left[torch.arange(40) != 7].abs().max()) < 0.06


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_exposure_projection_for_few_photos(count):
    projection = photometric._exposure_projection(ring(count, 48))
    assert projection.isfinite().all() and round(float(projection.trace())) == count - 1 - count // 4


def test_invisible_and_transparent_gaussians_are_pruned(device):
    true = random_gaussians(60, seed=2)
    cameras = ring(4, 48)
    views = photographed(true, cameras)
    means = true.means.clone()
    means[:5] = torch.tensor([0.0, 0, 50.0])  # far above all cameras, visible in no photo
    opacities = true.opacities.clone()
    opacities[5:10] = 1e-3
    start = Gaussians(means, true.quats, true.scales, opacities, true.sh, true.object_id)
    done = photometric.fit_gaussians(start, views, FitOptions(5, 2.0, device=device))
    assert len(done) <= 50
    assert done.means[:, 2].max() < 10


def test_split_halves_are_symmetric_and_smaller(device):
    start = random_gaussians(100, seed=3)
    fit = photometric._Fit.start(start.to(device), 1, 1.0)
    size = fit.values["scales"].detach().exp().max(1).values
    fit.gradients[7] = 1 / size[7]
    photometric._split(fit, torch.Generator().manual_seed(0))
    after = fit.gaussians().to("cpu")
    count = int(photometric.DENSITY.split_fraction * 100)
    assert len(after) == 100 + count
    torch.testing.assert_close((after.means[7] + after.means[100]) / 2, start.means[7], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(after.scales[100], start.scales[7] / 1.6, rtol=1e-2, atol=0)
