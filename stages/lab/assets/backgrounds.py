"""The eight backgrounds as Gaussians: a table in a room. Objects are placed in [-1, 1]^3 above the table top."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.lab.assets import background_paint as paint
from stages.lab.assets.paint import box2
from stages.lab.assets.shapes import Surface, noise, single_threaded, to_gaussians
from stages.lab.names import chosen_names

TABLE_HEIGHT, FLOOR_HEIGHT, CEILING_HEIGHT = -0.94, -2.5, 1.7  # z of table top, floor and ceiling [m]
# half widths of the square table and of the room [m]; cameras orbit at 3.8
TABLE_HALF_WIDTH, ROOM_HALF_WIDTH = 2.1, 6.6
TABLE_THICKNESS, LEG_HALF_WIDTH = 0.14, 0.13  # thickness of the table top, and half width of a leg [m]
TABLE_SPACING, ROOM_SPACING = 0.0235, 0.14  # spacing of Gaussians on the table top, and on floor and walls [m]
BACKGROUND_PLY = "gaussians_feedforward.ply"  # file name in the folder of a background
Paint = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Background:
    """Textures and colours of the table, the floor and the walls, and the shape of the table."""

    top: Paint
    wood: tuple[float, float, float]  # colour of sides and legs
    floor: Paint
    wall: Paint
    round: bool = False  # a round table with one leg
    overhang: float = 0.0  # length of the tablecloth below the top [m]; 0: no tablecloth


BACKGROUNDS = {
    "table0": Background(paint.oak, (0.5, 0.33, 0.18), paint.wooden_floor,
                         paint.panelled((0.85, 0.8, 0.7), (0.9, 0.89, 0.86))),
    "table1": Background(paint.marble, (0.3, 0.3, 0.32), paint.paving((0.78, 0.75, 0.7), (0.66, 0.62, 0.57), 1.1),
                         paint.panelled((0.5, 0.6, 0.68), (0.82, 0.84, 0.85)), round=True),
    "table2": Background(paint.gingham, (0.45, 0.3, 0.18), paint.wooden_floor, paint.bricks, overhang=0.45),
    "table3": Background(paint.flagstones, (0.42, 0.4, 0.37),
                         paint.mottled((0.14, 0.3, 0.08), (0.4, 0.56, 0.2), 0.4, 5), paint.garden),
    "table4": Background(paint.worn_paint, (0.28, 0.55, 0.56),
                         paint.mottled((0.7, 0.6, 0.44), (0.88, 0.79, 0.62), 0.6, 8),
                         paint.striped((0.9, 0.91, 0.9), (0.56, 0.71, 0.82), 0.9)),
    "table5": Background(paint.slate, (0.16, 0.15, 0.15), paint.dark_floor,
                         paint.mottled((0.5, 0.5, 0.49), (0.68, 0.67, 0.65), 1.2, 3)),
    "table6": Background(paint.azulejo, (0.4, 0.24, 0.13), paint.paving((0.74, 0.42, 0.27), (0.56, 0.28, 0.17), 0.8),
                         paint.mottled((0.82, 0.66, 0.38), (0.94, 0.83, 0.6), 1.0, 6)),
    "table7": Background(paint.felt, (0.26, 0.12, 0.07), paint.mottled((0.3, 0.07, 0.08), (0.45, 0.12, 0.12), 0.3, 9),
                         paint.panelled((0.2, 0.27, 0.22), (0.3, 0.17, 0.1), -0.9)),
}  # fmt: skip


def make_background(name: str) -> Gaussians:
    """A background by name: SH degree 0, object_id 0, table top at z = -0.94 [m], nothing above it.

    Deterministic. Raises InputError for an unknown name.
    """
    b = BACKGROUNDS[_known(name)]
    with single_threaded():
        return concatenate([_top(b), _sides(b), *_legs(b), _floor(b), *_walls(b)])


def _known(name: str) -> str:
    if name not in BACKGROUNDS:
        raise InputError(f"there is no background called {name!r}; choose from {', '.join(BACKGROUNDS)}")
    return name


def outline_distance(q: Float[Tensor, "n 2"], b: Background, grow: float = 0.0) -> Float[Tensor, "n"]:
    """Signed distance to the outline of the table top enlarged by `grow`; negative inside [m]."""
    return (
        q.norm(dim=1) - 1.15 * TABLE_HALF_WIDTH - grow
        if b.round
        else box2(q, (0, 0), (TABLE_HALF_WIDTH + grow, TABLE_HALF_WIDTH + grow), 0.08 + grow)
    )


def _top(b: Background) -> Gaussians:
    """The table top, slightly brighter in the middle, on a hexagonal grid."""
    half = TABLE_HALF_WIDTH * (1.15 if b.round else 1.0)
    rows, columns = int(2 * half / (TABLE_SPACING * 0.75**0.5)), int(2 * half / TABLE_SPACING)
    j, i = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    q = torch.stack([(i + 0.5 * (j % 2)) * TABLE_SPACING, j * TABLE_SPACING * 0.75**0.5], -1).reshape(-1, 2) - half
    q = q[outline_distance(q, b) < 0]
    rgb = b.top(q) * (1.04 - 0.035 * q.square().sum(1))[:, None].clamp_min(0.8)
    return _flat(torch.nn.functional.pad(q, (0, 1), value=TABLE_HEIGHT), (0.0, 0.0, 1.0), rgb, TABLE_SPACING)


def _sides(b: Background) -> Gaussians:
    """The edge of the table top, or the folds of the tablecloth over it."""
    step, drop = 1.6 * TABLE_SPACING, max(TABLE_THICKNESS, b.overhang)
    angle = torch.arange(0, 2 * torch.pi, 2e-3)
    ray = torch.stack([angle.cos(), angle.sin()], 1)
    far = torch.full((len(angle),), 1.5 * TABLE_HALF_WIDTH)
    for _ in range(60):  # sphere tracing towards the outline from outside
        far = far - 0.9 * outline_distance(ray * far[:, None], b)
    line = ray * far[:, None]
    along = torch.cat([torch.zeros(1), (line[1:] - line[:-1]).norm(dim=1).cumsum(0)])
    pick = torch.searchsorted(along, torch.arange(0.0, float(along[-1]), step))
    depth = torch.arange(0.5 * step, drop, step)
    column, down = torch.cartesian_prod(pick.float(), depth).unbind(1)
    column = column.long()
    edge, e = line[column], 1e-3
    x, y = (torch.tensor([[e, 0.0]]), torch.tensor([[0.0, e]]))
    normal = torch.stack([outline_distance(edge + d, b) - outline_distance(edge - d, b) for d in (x, y)], 1)
    normal = torch.nn.functional.normalize(torch.nn.functional.pad(normal, (0, 1)), dim=1)
    fold = 0.04 * torch.sin(along[column] * 14) * down / drop if b.overhang else 0 * down
    p = torch.cat([edge, (TABLE_HEIGHT - down)[:, None]], 1) + fold[:, None] * normal
    if b.overhang:
        straight = torch.stack([along[column], down], 1)
        rgb = b.top(straight) * (0.82 + 5.0 * fold)[:, None]
    else:
        rgb = torch.tensor(b.wood) * (0.85 + 0.3 * noise(p * torch.tensor([0.2, 0.2, 1.0]), 0.05, 2))[:, None]
    return to_gaussians(Surface(p, normal), rgb * _daylight(normal)[:, None], 0, width=0.66, widest=2 * step)


def _legs(b: Background) -> list[Gaussians]:
    """Four square legs, or one thick central leg for a round table."""
    step, half = 2.5 * TABLE_SPACING, 0.5 if b.round else LEG_HALF_WIDTH
    at = (
        [(0.0, 0.0)]
        if b.round
        else [
            (x, y)
            for x in (-TABLE_HALF_WIDTH + 0.3, TABLE_HALF_WIDTH - 0.3)
            for y in (-TABLE_HALF_WIDTH + 0.3, TABLE_HALF_WIDTH - 0.3)
        ]
    )
    side = torch.cartesian_prod(
        torch.arange(-half, half, step) + step / 2, torch.arange(FLOOR_HEIGHT, TABLE_HEIGHT - TABLE_THICKNESS, step)
    )
    legs = []
    for x, y in at:
        for axis in (0, 1):
            for sign in (-1.0, 1.0):
                normal = torch.zeros(3)
                normal[axis] = sign
                p = torch.zeros(len(side), 3)
                p[:, 1 - axis], p[:, axis], p[:, 2] = side[:, 0], sign * half, side[:, 1]
                rgb = torch.tensor(b.wood) * (0.6 + 0.3 * noise(p * torch.tensor([1.0, 1.0, 0.15]), 0.06, 3))[:, None]
                legs.append(_flat(p + torch.tensor([x, y, 0.0]), tuple(normal.tolist()), rgb * _daylight(normal), step))
    return legs


def _floor(b: Background) -> Gaussians:
    """The floor, darker under the table and near the walls."""
    line = torch.arange(-ROOM_HALF_WIDTH, ROOM_HALF_WIDTH, ROOM_SPACING)
    q = torch.cartesian_prod(line, line)
    shadow = 0.6 * torch.exp(-outline_distance(q, b).clamp_min(0) / 0.7) + 0.2 * torch.exp(
        (q.abs().amax(1) - ROOM_HALF_WIDTH) / 0.6
    )
    rgb = b.floor(q) * (1 - shadow)[:, None]
    return _flat(torch.nn.functional.pad(q, (0, 1), value=FLOOR_HEIGHT), (0.0, 0.0, 1.0), rgb, ROOM_SPACING)


def _walls(b: Background) -> list[Gaussians]:
    """Four walls, darker in the corners, each shaded by its orientation."""
    q = torch.cartesian_prod(
        torch.arange(-ROOM_HALF_WIDTH, ROOM_HALF_WIDTH, ROOM_SPACING),
        torch.arange(FLOOR_HEIGHT, CEILING_HEIGHT, ROOM_SPACING),
    )
    corner = 0.22 * torch.exp((q[:, 0].abs() - ROOM_HALF_WIDTH) / 0.7) + 0.3 * torch.exp((FLOOR_HEIGHT - q[:, 1]) / 0.5)
    walls = []
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        p = torch.zeros(len(q), 3)
        p[:, 1 - axis], p[:, axis], p[:, 2] = q[:, 0], sign * ROOM_HALF_WIDTH, q[:, 1]
        normal = [0.0, 0.0, 0.0]
        normal[axis] = -sign
        shifted = q + torch.tensor([ROOM_HALF_WIDTH * (2 * axis + sign), 0.0])
        rgb = b.wall(shifted) * (1 - corner)[:, None] * _daylight(torch.tensor(normal))
        walls.append(_flat(p, tuple(normal), rgb, ROOM_SPACING))
    return walls


def _daylight(normal: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Brightness of a vertical face, depending on its orientation to the light."""
    return 0.86 + 0.12 * (normal @ torch.tensor([-0.42, -0.9, 0.0]))


def _flat(p: Float[Tensor, "n 3"], normal: tuple[float, float, float], rgb: Tensor, step: float) -> Gaussians:
    surface = Surface(p, torch.tensor([normal]).expand(len(p), 3).contiguous())
    return to_gaussians(surface, rgb, 0, width=0.62 if step < ROOM_SPACING else 0.75, widest=1.2 * step)


def run(out: Path, only: str = "", sheet: Path | None = None) -> Iterator[str]:
    """Write OUT/<name>/gaussians_feedforward.ply for each background, and an image of all to `sheet`.

    `only` restricts them to a comma-separated list. Yields a line per background. Raises InputError for unknown names.
    """
    from stages.core.scene.files import make_folder, provenance
    from stages.core.scene.images import write_jpeg
    from stages.core.scene.scene import Scene
    from stages.core.scene.scene_ply import write_scene
    from stages.lab.assets.splat_files import background_portrait
    from stages.render.overlay import tile_images

    images = []
    names = chosen_names(only, BACKGROUNDS)
    make_folder(Path(out))
    for name in tqdm(names, desc="backgrounds", unit="background"):
        g = make_background(name)
        folder = Path(out) / name
        folder.mkdir(parents=True, exist_ok=True)
        write_scene(folder / BACKGROUND_PLY, Scene(g, (), None, TABLE_HEIGHT, provenance=provenance("backgrounds", [])))
        if sheet:
            images.append(background_portrait(g, name))
        yield f"{name}: {len(g)} Gaussians"
    if sheet:
        write_jpeg(sheet, tile_images(images, min(4, len(images))), 86)
