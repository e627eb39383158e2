"""The sam2 backend with a tiny random network, read by the loader of the published one."""

import json
from functools import partial
from pathlib import Path

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.hub import find_or_download
from stages.core.models.sam2 import weights as published
from stages.core.scene.images import write_png
from stages.core.scene.scene_ply import read_scene
from stages.segment.options import SegmentOptions
from stages.segment.prompted import point_prompts
from stages.segment.prompts import read_prompts
from stages.segment.stage import run
from stages.segment.view_images import render_view, view_images

pytest.importorskip("transformers")
pytestmark = pytest.mark.usefixtures("device", "one_thread")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    from tests.core.models.sam2.tiny_model import save_tiny_model

    return save_tiny_model(tmp_path_factory.mktemp("sam2"))


@pytest.fixture
def photos(truth, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for view, name in enumerate(truth.cameras.names):
        write_png(folder / name.replace(".jpg", ".png"), render_view(truth, view))
    return folder


def prompts_file(path, **data):
    path.write_text(json.dumps(data))
    return path


BOXES = {"bbox": [[10, 20, 60, 90], [80, 60, 150, 120]], "text": ["egg", "block"]}
POINTS = {"center_point": [[40, 60], [100, 90]], "bbox": []}


@pytest.mark.parametrize("prompts", [BOXES, POINTS], ids=["boxes", "points"])
def test_prompts_give_named_objects(scene_file, truth, weights, photos, tmp_path, prompts, device):
    """The masks are random, so only names, ids and provenance are checked."""
    boxes = prompts_file(tmp_path / "p.json", **prompts)
    run(scene_file, tmp_path / "out.ply", SegmentOptions(backend="sam2", boxes=boxes, photos=photos, weights=weights))
    labelled = read_scene(tmp_path / "out.ply")
    names = prompts.get("text", ["object_1", "object_2"])
    assert labelled.objects or device == "cuda"  # in bfloat16, random masks may not win any Gaussian
    assert all(o.name == names[o.id - 1] for o in labelled.objects)
    assert set(labelled.gaussians.object_id.unique().tolist()) == {0, *(o.id for o in labelled.objects)}
    inputs = [row["name"] for row in labelled.provenance["inputs"]]
    assert inputs == ["scene.ply", "p.json", "photos", weights.name]


def test_rendered_views_equal_their_photos(truth, photos):
    """They are equal up to the rounding of PNG to 8 bits."""
    shown, read = view_images(truth), view_images(truth, photos)
    assert shown.views == read.views == list(range(len(truth.cameras)))
    torch.testing.assert_close(shown.image(3), read.image(3), rtol=0, atol=0.51 / 255)


def test_photos_may_be_missing_except_the_prompted_one(scene_file, truth, weights, photos, tmp_path):
    (photos / "03.png").unlink()
    assert view_images(truth, photos).views == [0, 1, 2, 4, 5, 6, 7]
    boxes = prompts_file(tmp_path / "p.json", **BOXES)
    options = SegmentOptions(backend="sam2", boxes=boxes, photos=photos, weights=weights)
    run(scene_file, tmp_path / "out.ply", options)
    (photos / "00.png").unlink()
    with pytest.raises(InputError, match="does not contain 00.jpg, the photo to which --boxes refers"):
        run(scene_file, tmp_path / "other.ply", options)


def test_no_objects_from_a_network_without_confident_masks(scene_file, weights, tmp_path, caplog, monkeypatch):
    from stages.core.models.sam2 import segmenter
    from stages.core.models.sam2.mask_generation import MaskGenerationOptions, propose_masks

    monkeypatch.setattr(segmenter, "propose_masks", partial(propose_masks, options=MaskGenerationOptions(grid=4)))
    run(scene_file, tmp_path / "out.ply", SegmentOptions(backend="sam2", weights=weights))
    assert read_scene(tmp_path / "out.ply").objects == ()
    assert "no objects were found" in caplog.text


def test_missing_weights_are_reported(scene_file, tmp_path, monkeypatch):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(InputError, match=r"facebook/sam2.1-hiera-large \(0.9 GB.* into .*weights/sam2.*--download"):
        run(scene_file, tmp_path / "out.ply", SegmentOptions(backend="sam2"))
    assert not (tmp_path / "out.ply").exists()


def test_weights_are_downloaded_only_on_request_and_if_missing(weights, tmp_path, monkeypatch):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def found(given: Path | None, wanted: bool) -> Path:
        return find_or_download(published.find, lambda: Path("fetched"), given, wanted)

    assert found(None, True) == Path("fetched")
    assert found(weights, True) == weights / "model.safetensors"
    for given, wanted in ((tmp_path, True), (None, False)):
        with pytest.raises(InputError, match="no config.json"):
            found(given, wanted)


def test_photos_of_another_aspect_ratio_are_refused(scene_file, truth, weights, photos, tmp_path):
    write_png(photos / "05.png", render_view(truth, 5)[:80])
    boxes = prompts_file(tmp_path / "p.json", **BOXES)
    with pytest.raises(
        InputError, match="--photos: 05.jpg is 160x80 pixels, but 160x160 in the scene.*rendered instead"
    ):
        options = SegmentOptions(backend="sam2", boxes=boxes, photos=photos, weights=weights)
        run(scene_file, tmp_path / "out.ply", options)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"text": ["duck"]}, "neither a bbox nor a center_point"),
        ({**BOXES, "center_point": [[1, 2]]}, "2 boxes, 1 points and 2 names"),
        ({"center_point": [[1, 2, 3]]}, "is not a prompts file"),
        ({"bbox": [[5, 5, 1, 9]]}, "no area"),
    ],
)
def test_invalid_prompts_are_refused(truth, tmp_path, data, message):
    with pytest.raises(InputError, match=message):
        read_prompts(prompts_file(tmp_path / "p.json", **data), truth.cameras)


def test_boxes_backend_refuses_points(scene_file, tmp_path):
    boxes = prompts_file(tmp_path / "p.json", **POINTS)
    with pytest.raises(InputError, match="points only work with --backend sam2"):
        run(scene_file, tmp_path / "out.ply", SegmentOptions(boxes=boxes))


def test_point_prompts_are_fractions_of_the_view(truth, tmp_path):
    box, point = (point_prompts(read_prompts(prompts_file(tmp_path / "p.json", **p), truth.cameras), truth)[0]
                  for p in (BOXES, POINTS))  # fmt: skip
    torch.testing.assert_close(box.points, torch.tensor([[10 / 160, 20 / 160], [60 / 160, 90 / 160]]))
    torch.testing.assert_close(point.points, torch.tensor([[40 / 160, 60 / 160]]))
    assert box.labels.tolist() == [2, 3] and point.labels.tolist() == [1]
