"""Dense depth by multi-view stereo: plane sweep, semi-global matching, refinement, consistency check.

For each photo, hypotheses on a grid of inverse depth are scored by warping other photos to it and normalised
cross-correlation (Collins 1996, "A space-sweep approach to true multi-image matching"). A second sweep parallel to the
supporting plane scores horizontal surfaces, which fronto-parallel windows distort (Gallup et al. 2007, "Real-time
plane-sweeping stereo with multiple sweeping directions"). Costs are aggregated by semi-global matching (Hirschmueller
2008, eq. 13), which also propagates depth into areas without texture. Depth is then checked for consistency between
views.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from stages.core.geometry.cameras import centres, depths, resize
from stages.core.geometry.planes import Plane
from stages.core.kernels.semi_global import path_costs
from stages.core.kernels.threads import parallel_map
from stages.reconstruct.photos import Views
from stages.reconstruct.sfm import SparseModel

MAX_SOURCES = 4  # source views matched with each view
MAX_CHECK_VIEWS = 10  # views against which the depth of each view is checked
MAX_LABELS = 192  # depth hypotheses per pixel
WINDOW = 5  # side of the windows that are correlated [px]
MIN_CORRELATION = 0.3  # smallest correlation of a match
STEP_PENALTY, JUMP_PENALTY = 0.03, 0.25  # P1 and P2 of semi-global matching, for costs 0..1
DEPTH_TOLERANCE, PIXEL_TOLERANCE = 0.01, 1.5  # consistent depths: relative difference, and reprojection error [px]
REFINE_STEPS = (0.5, 0.2)  # step of each refinement round [steps of the hypothesis grid]
CPU_PIXELS, CUDA_CHUNK = 1 << 17, 64  # warped at once: pixels that fit in a CPU cache; hypotheses, for few launches
MOVE_COST = 0.02  # cost added per refinement step away from the current depth


@dataclass(frozen=True)
class DepthMap:
    """Depth along the viewing axis of one view [scene units].

    `support` is the number of consistent other views, or -1 in a backdrop without matches, whose depth is unknown.
    """

    depth: Float[Tensor, "h w"]
    support: Float[Tensor, "h w"]


def estimate_depth_maps(views: Views, model: SparseModel, plane: Plane | None, device: str = "cpu") -> list[DepthMap]:
    """Estimate a depth map of every view and check it against the others; `plane`: the supporting plane, if known."""
    checks = select_sources(model, MAX_CHECK_VIEWS)
    sources = [best[:MAX_SOURCES] for best in checks]
    raw, scores = [], []
    for i in tqdm(range(len(views)), desc="matching depth", unit="photo", leave=False):
        depth, score = _match_view(views, model, i, sources[i], plane, device)
        raw.append(depth)
        scores.append(score)
    checked = []
    for i in range(len(views)):
        others = {*checks[i], *(j for j in range(len(views)) if i in sources[j])}
        found = check_consistency(raw, views, i, sorted(others))
        support = found.support.masked_fill(_backdrop(scores[i]) & ~_on_plane(raw[i], views, i, plane), -1.0)
        checked.append(without_speckles(DepthMap(found.depth.cpu(), support.cpu())))
    return checked


def select_sources(model: SparseModel, count: int) -> list[list[int]]:
    """For every view, up to `count` others with most common points at a useful triangulation angle (about 10 degrees).

    Score of Yao et al. 2018, "MVSNet", sec. 4.1: a Gaussian in the triangulation angle, narrower below its mean.
    """
    eyes, c = centres(model.cameras.viewmats), len(model.cameras)
    observed = torch.zeros(c, len(model.points), dtype=torch.bool)
    observed[model.view_index, model.point_index] = True
    out = []
    for i in range(c):
        score = torch.zeros(c)
        for j in range(c):
            shared = model.points[observed[i] & observed[j]]
            if i == j or not len(shared):
                continue
            a, b = F.normalize(eyes[i] - shared, dim=1), F.normalize(eyes[j] - shared, dim=1)
            angle = torch.rad2deg(torch.acos((a * b).sum(1).clamp(-1, 1)))
            width = torch.where(angle < 10.0, 5.0, 15.0)
            score[j] = torch.exp(-((angle - 10) ** 2) / (2 * width**2)).sum()
        best = score.topk(min(count, c - 1))
        chosen = [j for j, s in zip(best.indices.tolist(), best.values.tolist(), strict=True) if s > 0]
        near = (eyes - eyes[i]).norm(dim=1).argsort(stable=True).tolist()
        out.append(chosen or [j for j in near if j != i][:count])
    return out


def _match_view(
    views: Views, model: SparseModel, i: int, sources: list[int], plane: Plane | None, device: str
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Depth of view i before the consistency check: plane sweep at half resolution, refined at full resolution.

    Also returns the correlation of the windows at this depth, from 0 to 1.
    """
    half = _Stereo(views, i, sources, 0.5, device)
    low, high = _depth_range(views, model, i)
    labels = half.labels(low, high)
    cost = half.cost(1 / labels[:, None, None].expand(-1, *half.size))
    eye = centres(views.cameras.viewmats[i : i + 1])[0]
    if plane is not None and plane.heights(eye) > 0:
        normal = (views.cameras.viewmats[i, :3, :3] @ plane.normal).to(device)
        cost = torch.minimum(cost, _slanted_cost(half, labels, normal, float(plane.heights(eye))))
    index = semi_global_matching(cost)
    inverse = labels[0] + index * (labels[1] - labels[0])
    full = _Stereo(views, i, sources, 1.0, device)
    inverse = F.interpolate(inverse[None, None], full.size, mode="bilinear", align_corners=False)[0, 0]
    step = float(labels[1] - labels[0])
    for fraction in REFINE_STEPS:
        inverse, score = _refined(full, inverse, fraction * step)
    return 1 / inverse.clamp(min=float(labels[0]) / 2), score


def _depth_range(views: Views, model: SparseModel, i: int) -> tuple[float, float]:
    """Nearest and farthest hypothesis [scene units]: the range of the sparse points of the view, with a margin."""
    seen = model.point_index[model.view_index == i]
    z = depths(model.points[seen if len(seen) >= 10 else slice(None)], views.cameras.viewmats[i])
    z = z[z > 0]
    if not len(z):
        raise ValueError(f"no point is in front of camera {i}")
    return 0.8 * float(z.quantile(0.01)), 3 * float(z.quantile(0.99))


class _Stereo:
    """Scores depth hypotheses of a reference view by its source views, at one resolution."""

    def __init__(self, views: Views, i: int, sources: list[int], scale: float, device: str):
        self.reference, K = _grey(views, i, scale, device)
        self.size = self.reference.shape
        viewmat = views.cameras.viewmats[i].to(device)
        y, x = torch.meshgrid(*(torch.arange(s, device=device) + 0.5 for s in self.size), indexing="ij")
        self.rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)])
        self.moments = _moments(self.reference[None])
        self.sources = []
        for j in sources:
            image, K_j = _grey(views, j, scale, device)
            motion = views.cameras.viewmats[j].to(device) @ torch.linalg.inv(viewmat)
            rotated = (K_j @ motion[:3, :3] @ self.rays.flatten(1)).unflatten(1, self.size)
            self.sources.append((image, rotated, K_j @ motion[:3, 3]))

    def labels(self, near: float, far: float) -> Float[Tensor, "d"]:
        """Inverse depths from far to near, at most about a pixel apart in any source; up to MAX_LABELS."""
        ends = []
        for _, rotated, shift in self.sources:
            pixel = [(rotated * z + shift[:, None, None]) for z in (near, far)]
            ends.append((pixel[0][:2] / pixel[0][2:] - pixel[1][:2] / pixel[1][2:]).norm(dim=0).median())
        count = int(torch.stack(ends).max().clamp(32, MAX_LABELS))
        return torch.linspace(1 / far, 1 / near, count, device=self.rays.device)

    def cost(self, depth: Float[Tensor, "d h w"]) -> Float[Tensor, "d h w"]:
        """Cost of each hypothesis, from 0 (equal) to 1 (uncorrelated): mean over the better half of the sources.

        In the other half the point may be occluded.
        """

        def cost_of(part: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
            scores = [self._correlation(part, *source) for source in self.sources]
            return 1 - _mean_of_better_half(scores).clamp(0, 1)

        if depth.is_cuda:
            return torch.cat([cost_of(part) for part in depth.split(CUDA_CHUNK)])
        return torch.cat(parallel_map(cost_of, depth.split(max(1, CPU_PIXELS // depth[0].numel()))))

    def _correlation(self, depth, image, rotated, shift) -> Float[Tensor, "d h w"]:
        """Normalised cross-correlation of windows; 0 where a point projects outside the source image."""
        x, y, z = (depth * ray + offset for ray, offset in zip(rotated, shift, strict=True))
        front = z > 0
        z.clamp_min_(1e-6)
        height, width = image.shape
        grid = depth.new_empty(*depth.shape, 2)
        for axis, (position, size) in enumerate(((x, width), (y, height))):
            position.div_(z).mul_(2 / size).sub_(1)
            grid[..., axis] = position
        inside = (x.abs_() < 1) & (y.abs_() < 1) & front
        batch = image.expand(len(depth), 1, height, width)
        warped = F.grid_sample(batch, grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]
        mean, variance = _moments(warped)
        cross = _box(warped * self.reference).sub_(mean.mul_(self.moments[0]))
        return cross.div_(variance.mul_(self.moments[1]).sqrt_()).masked_fill_(~inside, 0.0)


def _mean_of_better_half(scores: list[Float[Tensor, "*b"]]) -> Float[Tensor, "*b"]:
    """Elementwise mean of the larger half of a few tensors, by a bubble sort: ten times as fast as `topk`."""
    scores, keep = list(scores), (len(scores) + 1) // 2
    for place in range(keep):
        for k in range(len(scores) - 1, place, -1):
            a, b = scores[k - 1 : k + 1]
            scores[k - 1 : k + 1] = torch.maximum(a, b), torch.minimum(a, b)
    return sum(scores[1:keep], scores[0]) / keep


def _grey(views: Views, i: int, scale: float, device: str) -> tuple[Float[Tensor, "h w"], Float[Tensor, "3 3"]]:
    """The grey image of view i at a fraction of its size, and its K."""
    image = views.image(i, device) @ torch.tensor([0.299, 0.587, 0.114], device=device)
    height, width = image.shape
    size = max(8, round(height * scale)), max(8, round(width * scale))
    if size != (height, width):
        image = F.interpolate(image[None, None], size, mode="area")[0, 0]
    return image, resize(views.cameras.Ks[i], size[1] / width, size[0] / height).to(device)


def _box(images: Float[Tensor, "d h w"]) -> Float[Tensor, "d h w"]:
    """Mean over 5 x 5 pixels with replicated edges; shifted sums are ten times as fast as average pooling on a CPU."""
    padded = F.pad(images[None], (2, 2, 2, 2), mode="replicate")[0]
    pairs = padded[..., :-1] + padded[..., 1:]
    rows = pairs[..., :-3] + pairs[..., 2:-1]
    rows += padded[..., 4:]
    pairs = rows[:, :-1] + rows[:, 1:]
    total = pairs[:, :-3] + pairs[:, 2:-1]
    total += rows[:, 4:]
    return total.mul_(1 / 25)


def _moments(images: Float[Tensor, "d h w"]) -> tuple[Tensor, Tensor]:
    """Mean and variance over the window; a variance of (2 grey levels)^2 is added to suppress noise."""
    mean = _box(images)
    return mean, _box(images * images).sub_(mean * mean).clamp_min_(0).add_((2 / 255) ** 2)


def _slanted_cost(
    stereo: _Stereo, labels: Float[Tensor, "d"], normal: Float[Tensor, "3"], height: float
) -> Float[Tensor, "d h w"]:
    """Cost of each hypothesis and pixel for a surface parallel to the supporting plane.

    `normal`: upward normal of the plane in camera axes; `height`: distance of the camera from the plane. The sweep
    covers planes from slightly below the supporting plane to halfway up to the camera, and is interpolated at the depth
    of each label: a plane at a distance h below the camera is at depth h / slope.
    """
    slope = -(normal[:, None, None] * stereo.rays).sum(0)
    facing = slope > 0.1  # excludes rays at less than about 6 degrees to the plane
    if facing.float().mean() < 0.02:
        return torch.ones(len(labels), *stereo.size, device=labels.device)
    slope = slope.clamp_min(0.1)
    step = (labels[1] - labels[0]) / slope[facing].median()
    low, high = 1 / (1.2 * height), 1 / (0.5 * height)
    inverse = torch.linspace(low, high, int(((high - low) / step).clamp(16, MAX_LABELS)), device=labels.device)
    cost = stereo.cost((1 / inverse)[:, None, None] / slope)
    position = (labels[:, None, None] / slope - low) / (inverse[1] - inverse[0])
    known = (position >= 0) & (position <= len(inverse) - 1) & facing
    left = position.clamp(0, len(inverse) - 1.001)
    row = left.long()
    interpolated = torch.lerp(cost.gather(0, row), cost.gather(0, row + 1), left - row)
    return torch.where(known, interpolated, torch.ones_like(interpolated))


def semi_global_matching(cost: Float[Tensor, "d h w"]) -> Float[Tensor, "h w"]:
    """The label of each pixel, with a fraction from a parabola, by semi-global matching along rows and columns."""
    lines = cost.permute(2, 1, 0).contiguous()  # (w, h, d): one slice per step along the row
    total = path_costs(lines, STEP_PENALTY, JUMP_PENALTY).transpose(0, 1)
    total = total + path_costs(lines.transpose(0, 1).contiguous(), STEP_PENALTY, JUMP_PENALTY)
    best = total.argmin(-1)
    centre = best.clamp(1, total.shape[-1] - 2)[..., None]
    before, here, after = (total.gather(-1, centre + k)[..., 0] for k in (-1, 0, 1))
    curvature = (before - 2 * here + after).clamp_min(1e-6)
    fraction = ((before - after) / (2 * curvature)).clamp(-0.5, 0.5)
    return torch.where(best == centre[..., 0], best + fraction, best.to(fraction))


def _refined(
    stereo: _Stereo, inverse: Float[Tensor, "h w"], step: float
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Refine inverse depth by moving it up to two steps to the best match; also returns the correlation there.

    Every pixel is warped with its own depth, so windows follow slanted surfaces. Costs are averaged over a window and
    grow with the distance of the move, so areas without texture do not change.
    """
    moves = torch.arange(-2, 3, device=inverse.device, dtype=inverse.dtype)
    hypotheses = (inverse + moves[:, None, None] * step).clamp_min(1e-6)
    cost = _box(stereo.cost(1 / hypotheses)) + MOVE_COST * moves.abs()[:, None, None]
    least, best = cost.min(0, keepdim=True)
    centre = best.clamp(1, 3)
    before, here, after = (cost.gather(0, centre + k) for k in (-1, 0, 1))
    fraction = ((before - after) / (2 * (before - 2 * here + after).clamp_min(1e-6))).clamp(-0.5, 0.5)
    move = torch.where(best == centre, best + fraction, best.to(fraction))[0] - 2
    return inverse + move * step, 1 - least[0]


def check_consistency(maps: list[Tensor], views: Views, i: int, others: list[int]) -> DepthMap:
    """Average the depth of view i with that of the consistent views, and count these.

    A view is consistent if its depth at the point agrees within DEPTH_TOLERANCE and its point projects back to
    within PIXEL_TOLERANCE of the pixel (Galliani et al. 2015, "Massively parallel multiview stereopsis", sec. 4).
    """
    depth, cameras = maps[i], views.cameras
    Ks, viewmats = cameras.Ks.to(depth), cameras.viewmats.to(depth)
    K, viewmat = Ks[i], viewmats[i]
    pixels, points = unproject(depth, K, viewmat)
    total, support = depth.clone(), torch.zeros_like(depth)
    for j in others:
        other, inside = look_up_points(maps[j], points, Ks[j], viewmats[j])
        back = torch.cat([other, torch.ones_like(other[..., :1])], -1) @ viewmat.mT
        z = back[..., 2]
        reprojected = back[..., :2] / z[..., None].clamp_min(1e-9) * K.diagonal()[:2] + K[:2, 2]
        close = (reprojected - pixels).norm(dim=-1) < PIXEL_TOLERANCE
        agrees = inside & close & ((z - depth).abs() < DEPTH_TOLERANCE * depth)
        total += torch.where(agrees, z, torch.zeros_like(z))
        support += agrees
    return DepthMap(total / (1 + support), support)


def _backdrop(score: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Pixels of areas without matches (by their correlation) that reach the border of the image.

    Semi-global matching extends the depth of objects in front of a plain backdrop into it.
    """
    plain = (score < MIN_CORRELATION).cpu().numpy().astype(np.uint8)
    window = np.ones((WINDOW, WINDOW), np.uint8)
    _, area = cv2.connectedComponents(cv2.erode(plain, window))  # gaps in outlines do not join areas
    border = np.unique(np.concatenate([area[0], area[-1], area[:, 0], area[:, -1]]))
    open_areas = np.isin(area, border[border > 0]).astype(np.uint8)
    return torch.from_numpy(cv2.dilate(open_areas, window) > 0).to(score.device)


def _on_plane(depth: Float[Tensor, "h w"], views: Views, i: int, plane: Plane | None) -> Bool[Tensor, "h w"]:
    """Pixels whose depth is within 3 % of that of the supporting plane, if there is one."""
    if plane is None:
        return torch.zeros_like(depth, dtype=torch.bool)
    viewmat = views.cameras.viewmats[i]
    _, points = unproject(depth, views.cameras.Ks[i].to(depth), viewmat.to(depth))
    heights = points @ plane.normal.to(depth) - plane.offset
    # along a ray heights are linear in depth
    return heights.abs() < 0.03 * abs(float(plane.heights(centres(viewmat[None])[0])))


def without_speckles(found: DepthMap) -> DepthMap:
    """The map with a support of 0 in connected areas of consistent depth that are smaller than a window.

    Where there is no texture, the depths of a few views agree by chance here and there.
    """
    step = 1000  # per unit of the logarithm
    level = (found.depth / found.depth.median()).log().mul(step).round().clamp(-32000, 32000)
    areas = level.masked_fill(found.support <= 0, -32768).cpu().numpy().astype(np.int16)
    cv2.filterSpeckles(areas, -32768, WINDOW**2, round(step * DEPTH_TOLERANCE))
    small = torch.from_numpy(areas == -32768).to(found.support.device)
    return DepthMap(found.depth, torch.where(small, found.support.clamp(max=0), found.support))


def unproject(
    depth: Float[Tensor, "h w"], K: Float[Tensor, "3 3"], viewmat: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w 3"]]:
    """Pixel centres [px] and their world points at the given depth."""
    y, x = torch.meshgrid(*(torch.arange(s, device=depth.device) + 0.5 for s in depth.shape), indexing="ij")
    pixels = torch.stack([x, y], -1)
    camera = torch.cat([(pixels - K[:2, 2]) / K.diagonal()[:2], torch.ones_like(x)[..., None]], -1) * depth[..., None]
    return pixels, (camera - viewmat[:3, 3]) @ viewmat[:3, :3]


def look_up_points(
    depth: Float[Tensor, "h w"], points: Float[Tensor, "*b 3"], K: Float[Tensor, "3 3"], viewmat: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "*b 3"], Bool[Tensor, "*b"]]:
    """Surface points that a view sees at the projections of `points`, and a mask of projections inside the image.

    A surface point is on the exact ray of the projection, at the depth of the pixel that contains it.
    """
    camera = points @ viewmat[:3, :3].mT + viewmat[:3, 3]
    z = camera[..., 2]
    xy = camera[..., :2] / z[..., None].clamp_min(1e-9) * K.diagonal()[:2] + K[:2, 2]
    height, width = depth.shape
    inside = (z > 0) & (xy >= 0).all(-1) & (xy[..., 0] < width) & (xy[..., 1] < height)
    column = xy[..., 0].nan_to_num().clamp(0, width - 1).long()
    row = xy[..., 1].nan_to_num().clamp(0, height - 1).long()
    d = depth[row, column]
    surface = torch.cat([(xy - K[:2, 2]) / K.diagonal()[:2], torch.ones_like(d)[..., None]], -1) * d[..., None]
    return (surface - viewmat[:3, 3]) @ viewmat[:3, :3], inside
