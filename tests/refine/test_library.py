"""The completer "library": a matching asset completes an object, others are rejected."""

import logging
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, intrinsics, look_at
from stages.core.geometry.harmonics import C0
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.perception.observed_space import ObservedSpace
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.evaluate.scenes import chamfer, nearest_neighbours
from stages.lab.assets.shapes import ellipsoid
from stages.refine.library import load_library, transformed
from stages.refine.options import RefineOptions
from stages.refine.stage import refine, run
from tests.conftest import random_gaussians
from tests.refine.sample_objects import asymmetric_object
from tests.segment.tabletop import coloured_gaussians, scene_of, table_gaussians

SIZE, TURN = 0.3, matrix(torch.tensor([0.9, 0.0, 0.0, 0.4]))
PLACE = Similarity(SIZE, TURN, torch.tensor([0.02, -0.03, 0.1 * SIZE]))
pytestmark = pytest.mark.usefixtures("device")
DARK = 0.85  # brightness of the object in the photos relative to that in the library


@pytest.fixture(scope="module")
def truth():
    return transformed(asymmetric_object(), PLACE)


@pytest.fixture(scope="module")
def seen(truth) -> Scene:
    """The visible part of an object on a table for four cameras on one side, darker than in the library."""
    black = -0.5 / C0
    scene = scene_of(table_gaussians(0.02), replace(truth, sh=black + DARK * (truth.sh - black)))
    all_round = scene.cameras
    ahead = torch.nonzero(centres(all_round.viewmats)[:, 1] < -0.1)[:, 0]
    cameras = replace(
        all_round, viewmats=all_round.viewmats[ahead], Ks=all_round.Ks[ahead], sizes=all_round.sizes[ahead],
        names=tuple(all_round.names[i] for i in ahead.tolist()),
    )  # fmt: skip
    scene = replace(scene, objects=(SceneObject(1, "thing"),), cameras=cameras)
    g = scene.gaussians
    return replace(scene, gaussians=g[(ObservedSpace.of(scene).weight > 0.02) | (g.object_id == 0)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    home = tmp_path_factory.mktemp("library")
    write_scene(home / "thing.ply", Scene(asymmetric_object()))
    nested = home / "egg/point_cloud/iteration_30000"
    nested.mkdir(parents=True)
    write_scene(
        nested / "point_cloud.ply", Scene(coloured_gaussians(ellipsoid((0.3, 0.25, 0.5), 4000), (0.9, 0.9, 0.85), 1))
    )
    return home


@pytest.fixture(scope="module")
def whole(seen, folder, device) -> Scene:
    return refine(seen, RefineOptions(library=folder, background=False, keep_raw=True, device=device))


def test_unseen_side_is_completed(seen, whole, truth):
    before, after = (s.gaussians.means[s.gaussians.object_id == 1] for s in (seen, whole))
    far = [chamfer(nearest_neighbours(p, truth.means), nearest_neighbours(truth.means, p)) for p in (before, after)]
    assert far[1]["to_prediction"] < 0.2 * far[0]["to_prediction"]
    assert far[1]["to_truth"] < 0.01 * SIZE


def test_asset_colours_are_adapted_to_the_photos(whole, truth):
    g = whole.gaussians[whole.gaussians.object_id == 1]
    back = g[g.means[:, 1] > 0.045]
    there = nearest_neighbours(back.means, truth.means).index
    rgb, bright = (x.sh[:, 0] * C0 + 0.5 for x in (back, truth[there]))
    assert float(rgb.sum() / bright.sum()) == pytest.approx(DARK, abs=0.06)


def test_keep_raw_appends_the_uncompleted_objects(seen, whole):
    assert [(o.id, o.name) for o in whole.objects] == [(1, "thing"), (2, "thing (raw)")]
    raw = whole.gaussians.means[whole.gaussians.object_id == 2]
    assert len(raw) <= int((seen.gaussians.object_id == 1).sum())
    assert len(raw) < int((whole.gaussians.object_id == 1).sum())


def test_object_without_a_matching_asset_is_unchanged(folder, caplog):
    strange = coloured_gaussians(ellipsoid((0.05, 0.05, 0.12), 3000).moved((0, 0, 0.12)), (0.1, 0.7, 0.7), 1)
    scene = replace(scene_of(table_gaussians(0.02), strange), objects=(SceneObject(1, "bottle"),))
    with caplog.at_level(logging.INFO):
        refined = refine(scene, RefineOptions(library=folder, background=False))
    assert int((refined.gaussians.object_id == 1).sum()) <= len(strange)
    assert "bottle" in caplog.text and "unchanged" in caplog.text


def test_transformed_gaussians_render_equally_from_a_transformed_camera():
    g = random_gaussians(200, degree=2)
    there = Similarity(1.7, matrix(torch.tensor([0.5, 0.3, -0.6, 0.2])), torch.tensor([1.0, -2.0, 0.5]))
    viewmat, K = look_at(torch.tensor([2.0, 1.0, 1.5]), torch.zeros(3))[None], intrinsics(48, 48, 60.0)[None]
    before = rasterise(g, viewmat, K, 48, 48).rgb
    after = rasterise(transformed(g, there), there.viewmats(viewmat), K, 48, 48).rgb
    torch.testing.assert_close(before, after, rtol=0, atol=2e-3)


def test_invalid_libraries_are_refused(seen, tmp_path):
    write_scene(tmp_path / "labelled.ply", seen)
    for folder, message in ((tmp_path / "none", "is not a folder"), (tmp_path / "empty", "contains no .ply")):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(InputError, match=message):
            run(tmp_path / "labelled.ply", tmp_path / "out.ply", RefineOptions(library=folder))
    with pytest.raises(InputError, match="--library"):
        RefineOptions(completer="library")


def test_suffixes_have_any_case_and_hidden_files_do_not_count(tmp_path):
    (tmp_path / "duck/output").mkdir(parents=True)
    for name in ("BALL.PLY", "duck/output/a.ply"):
        write_scene(tmp_path / name, Scene(random_gaussians(200)))
    (tmp_path / "._BALL.PLY").write_text("as macOS writes")
    (tmp_path / "duck/output/._z.ply").write_text("as macOS writes")
    assert list(load_library(tmp_path, "cpu")) == ["BALL", "duck"]


def test_provenance_records_the_library(seen, folder, tmp_path):
    write_scene(tmp_path / "labelled.ply", replace(seen, gaussians=concatenate([seen.gaussians[::4]])))
    with pytest.raises(InputError, match="--library.*: does not work with --completer none"):
        RefineOptions(completer="none", library=folder)
    options = RefineOptions(library=folder, background=False)
    run(tmp_path / "labelled.ply", tmp_path / "out.ply", options)
    assert read_scene(tmp_path / "out.ply").provenance["options"]["library"] == str(folder)
