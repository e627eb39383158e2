"""Pack a scene or a trajectory into one HTML file: Gaussians and the motion of their keypoints, quantised."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.physics.shadow_casting import ShadowCaster
from stages.core.physics.skinning import keypoint_neighbours
from stages.core.player.container import PackedArray, bits_for, pack, quantised, whole
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Binding, Keypoints, Trajectory

WEB = Path(__file__).parent / "web"
MIN_DRAWN_OPACITY = 1 / 255  # opacity below which Gaussians are left out; the rasteriser does not draw them either
KEYPOINT_BITS = 16  # resolution over the extent of the keypoints at rest; a larger extent of the motion has more bits
POSITION_STEP = 0.05  # quantisation step of centres [typical smallest scale of the Gaussians]
HARMONICS_BITS = (10, 8, 7, 6)  # per band of spherical harmonics
WEIGHT_BITS, OPACITY_BITS, SCALE_BITS, QUATERNION_BITS, IRRADIANCE_BITS = 8, 8, 10, 10, 12
OUTLIERS = 1e-4  # fraction of the harmonics clipped at either end of their range


@dataclass(frozen=True)
class Motion:
    """Motion of the keypoints, and the other parts of a simulation that the page shows."""

    keypoints: Keypoints
    binding: Binding
    positions: Float[Tensor, "t p 3"]  # [scene units]
    com: Float[Tensor, "t o 3"]  # [scene units]
    rotation: Float[Tensor, "t o 4"]  # w x y z, relative to the rest frame
    dt: float  # time between frames [s]
    forces: tuple[dict, ...] = ()  # as in SimulationInfo
    field: tuple[dict, dict[str, PackedArray]] | None = None  # from `playable_parts`, for a page that simulates

    @classmethod
    def of(cls, t: Trajectory) -> Motion:
        """The motion of a trajectory."""
        return cls(t.keypoints, t.binding, t.positions, t.com, t.rotation, t.info.dt, t.info.forces)


def pack_film(
    scene: Scene,
    motion: Motion | None = None,
    settings: Mapping = {},
    shadows: ShadowCaster | None = None,  # noqa: B006
) -> bytes:
    """The container of a scene at rest or in motion, without Gaussians too transparent to be drawn.

    `settings` are passed on to the page: `view` {viewmat, K, size}, `target`, `colours`, `arrows`, `live`, `title`.
    With `shadows` the page draws the shadows of moving objects.
    """
    g = scene.gaussians.to("cpu")
    bound = torch.zeros(len(g), dtype=torch.bool) if motion is None else (motion.binding.index >= 0).any(1)
    rows = _drawing_order(g, bound)
    g, count = g[rows], int(bound[rows].sum())
    arrays = _gaussian_arrays(g)
    header = {
        **settings,
        "background": scene.background or (1.0, 1.0, 1.0),
        "objects": [{"id": o.id, "name": o.name, "material": o.material} for o in scene.objects],
        "cameras": [] if scene.cameras is None else [
            {"name": name, "viewmat": viewmat.tolist(), "K": K.tolist(), "size": size.tolist()}
            for name, viewmat, K, size in zip(
                scene.cameras.names, scene.cameras.viewmats, scene.cameras.Ks, scene.cameras.sizes, strict=True)
        ],
    }  # fmt: skip
    if motion is not None:
        header |= {"dt": motion.dt, "frames": len(motion.positions), "forces": motion.forces}
        arrays |= _motion_arrays(motion, rows[:count])
    if motion is not None and motion.field is not None:
        header |= {"field": motion.field[0]}
        arrays |= motion.field[1]
    if motion is not None and shadows is not None:
        header["light"] = asdict(shadows.light)
        arrays |= _shadow_arrays(shadows, g)
    return pack(header, arrays)


def _shadow_arrays(shadows: ShadowCaster, g: Gaussians) -> dict[str, PackedArray]:
    """The spheres of the objects at rest with their binding, and the irradiance that is baked into the colours."""
    rest, binding = shadows.occluders.rest, shadows.occluders.binding
    return {
        "spheres": quantised(torch.cat([rest.centres, rest.radii[:, None]], 1), KEYPOINT_BITS),
        "sphere_object": whole(rest.object_id[:, None]),
        "sphere_share": quantised(rest.weights[:, None], KEYPOINT_BITS),
        "sphere_index": whole(binding.index.clamp_min(0)),
        "sphere_weight": quantised(binding.weight, WEIGHT_BITS, axes=1),
        "rest_irradiance": quantised(shadows.rest_irradiance(g)[:, None], IRRADIANCE_BITS),
    }


def film_page(film: bytes, title: str) -> str:
    """The HTML file that plays a film from `pack_film`; it fetches nothing."""
    modules = {f"player/{file.name}": _data_url(file) for file in sorted(WEB.glob("*.js"))}
    parts = {
        "TITLE": escape(title.encode(errors="replace").decode()),  # a file name need not be valid UTF-8
        "STYLE": (WEB / "style.css").read_text(encoding="utf-8"),
        "IMPORTS": json.dumps({"imports": modules}), "FILM": base64.b64encode(film).decode(),
    }  # fmt: skip
    return fill_template((WEB / "index.html").read_text(encoding="utf-8"), parts)


def fill_template(template: str, parts: dict[str, str]) -> str:
    """The template with every {{NAME}} replaced by the part of that name."""
    before, *rest = template.split("{{")
    pieces = [piece.partition("}}") for piece in rest]
    return before + "".join(parts[name] + after for name, _, after in pieces)


def _data_url(file: Path) -> str:
    return "data:text/javascript;base64," + base64.b64encode(file.read_bytes()).decode()


def _drawing_order(g: Gaussians, bound: Tensor) -> Int[Tensor, "m"]:
    """Rows of the drawable Gaussians: those bound to keypoints first, then by object, then along a Morton curve."""
    finite = torch.stack([getattr(g, name).flatten(1).isfinite().all(1) for name in ("means", "quats", "scales", "sh")])
    rows = (finite.all(0) & (g.opacities >= MIN_DRAWN_OPACITY)).nonzero()[:, 0]
    x = g.means[rows].double()
    some = x[:: 1 + len(x) // 100_000] if len(x) else x.new_zeros(1, 3)
    low, high = (torch.quantile(some, q, dim=0) for q in (0.01, 0.99))
    cell = ((x - low) / (high - low).clamp_min(1e-9) * 1023).clamp(0, 1023).long()
    code = sum(((cell[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))  # Morton
    key = (~bound[rows]).long() << 62 | g.object_id[rows].long() << 31 | code
    return rows[key.argsort(stable=True)]


def _gaussian_arrays(g: Gaussians) -> dict[str, PackedArray]:
    """Centres, orientations, scales, opacities, colours and objects of the Gaussians."""
    extent = float((g.means.amax(0) - g.means.amin(0)).max()) if len(g) else 1.0
    smallest = float(g.scales.amax(1).quantile(0.05)) if 0 < len(g) < 1_000_000 else 1e-4 * extent
    degree = round(g.sh.shape[1] ** 0.5) - 1
    while degree and not bool(g.sh[:, degree**2 :].any()):
        degree -= 1
    bands = {
        f"harmonics{l}": quantised(_clipped(g.sh[:, l * l : (l + 1) ** 2].flatten(1)), HARMONICS_BITS[l])
        for l in range(degree + 1)
    }
    return {
        "means": quantised(g.means, bits_for(extent, POSITION_STEP * smallest)),
        "quats": quantised(torch.nn.functional.normalize(g.quats, dim=1), QUATERNION_BITS),
        "scales": quantised(g.scales.clamp_min(1e-9).log(), SCALE_BITS),
        "opacities": quantised(g.opacities[:, None], OPACITY_BITS),
        "object_id": whole(g.object_id[:, None]),
        **bands,
    }


def _clipped(x: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
    """The values with outliers clipped, which would coarsen the quantisation of all others."""
    if len(x) < 1000:
        return x
    thinned = x[:: 1 + len(x) // 100_000]
    return x.clamp(thinned.quantile(OUTLIERS, dim=0), thinned.quantile(1 - OUTLIERS, dim=0))


def _motion_arrays(motion: Motion, rows: Int[Tensor, "m"]) -> dict[str, PackedArray]:
    """Keypoints at rest and in every frame, their neighbours, and the binding of the Gaussians `rows`."""
    keypoints, t = motion.keypoints, len(motion.positions)
    all_frames = torch.cat([keypoints.rest[None], motion.positions])
    extents = [float((x.amax((0, 1)) - x.amin((0, 1))).max()) for x in (all_frames[:1], all_frames)]
    bits = bits_for(extents[1], extents[0] / 2**KEYPOINT_BITS)
    return {
        # one quantisation grid for rest and frames, so that resting keypoints stay exactly at rest
        "keypoints": quantised(all_frames.flatten(1), bits, axes=3, delta=True),
        "keypoint_object": whole(keypoints.object_id[:, None]),
        "neighbours": whole(keypoint_neighbours(keypoints)),
        "binding_index": whole(motion.binding.index[rows].clamp_min(0)),
        "binding_weight": quantised(motion.binding.weight[rows], WEIGHT_BITS, axes=1),
        "com": quantised(motion.com.reshape(t, -1), 20, axes=3, delta=True),
        "rotation": quantised(motion.rotation.reshape(t, -1), 16, axes=4, delta=True),
    }
