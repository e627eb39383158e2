"""The eight backgrounds: position and density of the table top, free space above it, variety, files."""

from functools import cache

import numpy as np
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.geometry.harmonics import C0
from stages.core.raster.rasterise import rasterise
from stages.core.scene.scene_ply import read_scene
from stages.lab.assets.background_paint import line_distance, voronoi_cells
from stages.lab.assets.backgrounds import BACKGROUND_PLY, BACKGROUNDS, ROOM_HALF_WIDTH, make_background
from tests.conftest import CliRunner

NAMES = list(BACKGROUNDS)


background = cache(make_background)


def top_of(g):
    return g[(g.means[:, 2] + 0.94).abs() < 1e-5]


@pytest.mark.parametrize("name", NAMES)
def test_table_top_is_dense_with_free_space_above(name):
    g = background(name)
    assert 40_000 < len(g) < 65_000 and (g.object_id == 0).all()
    over_table = (g.means[:, :2].abs() < 1.9).all(1)
    assert not (g.means[over_table, 2] > -0.94 + 1e-5).any()
    top = top_of(g).means[:, :2]
    counts = np.histogram2d(*top.T.numpy(), bins=np.linspace(-1.9, 1.9, 39))[0]  # counts in squares of side 0.1
    disc = np.hypot(*np.meshgrid(np.linspace(-1.85, 1.85, 38), np.linspace(-1.85, 1.85, 38))) < 2.2
    assert counts[disc].min() > 12  # 0.01 m^2 contains 21 at a spacing of 0.0235


@pytest.mark.parametrize("name", ["table1", "table2"])
def test_background_fills_every_view_of_the_data_set(name):
    """Hardly any pixel is transparent in views from inside the room."""
    g = background(name)
    viewmats = orbit(5, torch.tensor([0.0, 0.0, -0.3]), 4.0, 20.0)
    seen = rasterise(g, viewmats, intrinsics(96, 96, 144.0).expand(5, 3, 3), 96, 96).alpha
    assert (seen > 0.9).float().mean() > 0.99
    assert ROOM_HALF_WIDTH > 4.0


def test_tops_are_distinct():
    """Any two have different mean colours or spreads of brightness."""
    looks = []
    for name in NAMES:
        rgb = top_of(background(name)).sh[:, 0] * C0 + 0.5
        looks.append(torch.cat([rgb.mean(0), rgb.mean(1).std()[None]]))
    looks = torch.stack(looks)
    apart = torch.cdist(looks, looks) + torch.eye(8)
    assert apart.min() > 0.05


def test_backgrounds_are_deterministic():
    a, b = background("table3"), make_background("table3")
    assert torch.equal(a.means, b.means) and torch.equal(a.sh, b.sh) and torch.equal(a.quats, b.quats)


def test_line_distances_and_voronoi_cells():
    torch.testing.assert_close(
        line_distance(torch.tensor([0.0, 0.3, 1.1, -0.1]), 1.0), torch.tensor([0.0, 0.3, 0.1, 0.1])
    )
    border, tone = voronoi_cells(torch.rand(5000, 2, generator=torch.Generator().manual_seed(0)) * 4, 0.5, 1)
    assert (border >= 0).all() and border.max() < 0.5 and tone.unique().numel() > 30


def test_command_writes_the_published_names(tmp_path):
    picture = str(tmp_path / "b.jpg")
    done = CliRunner().invoke(app, ["backgrounds", str(tmp_path), "--only", "table6", "--sheet", picture])
    assert done.exit_code == 0, done.output
    scene = read_scene(tmp_path / "table6" / BACKGROUND_PLY)
    assert BACKGROUND_PLY == "gaussians_feedforward.ply" and len(scene.gaussians) == len(background("table6"))
    assert scene.floor == pytest.approx(-0.94) and not scene.objects
    assert (tmp_path / "b.jpg").stat().st_size > 1000


def test_unknown_background_lists_the_names(tmp_path):
    with pytest.raises(InputError, match="no background called 'table9'; choose from table0"):
        make_background("table9")
    done = CliRunner().invoke(app, ["backgrounds", str(tmp_path), "--only", "table0,table9"])
    assert done.exit_code == 2 and not list(tmp_path.iterdir())
