"""Objects at points given by the user."""

from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import project
from stages.core.models.segmenter import clicks
from stages.core.models.segmenter.voxels import SCALES
from stages.core.perception import view_outlines
from stages.core.perception.voting import ViewFootprint
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.points import parse_points, segment
from tests.segment.tabletop import best_overlap, three_apart


def unlabelled(scene: Scene) -> Scene:
    return replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)))


def at(scene: Scene, number: int, view: int, name: str) -> str:
    """Option text of a point at the top of an object in a view."""
    means = scene.gaussians.means[scene.gaussians.object_id == number]
    top = torch.cat([means[:, :2].mean(0), means[:, 2].max()[None]])
    x, y = project(top[None], scene.cameras.viewmats[view], scene.cameras.Ks[view])[0].tolist()
    return f"view={scene.cameras.names[view]} xy={x:.1f},{y:.1f} name={name}"


def test_the_objects_at_the_points_are_found_with_their_names(device, monkeypatch):
    monkeypatch.setattr(clicks, "SCALES", SCALES[:2])  # two of three, each of which takes a second
    scene = three_apart(side=0.56)
    points = at(scene, 3, 0, "green tower"), at(scene, 1, 4, "brick")
    found = segment(unlabelled(scene), SegmentOptions(points=points, device=device))
    assert [(o.id, o.name) for o in found.objects] == [(1, "green tower"), (2, "brick")]
    overlap = best_overlap(found.gaussians.object_id, scene.gaussians.object_id)
    assert overlap[3] > 0.85 and overlap[1] > 0.85
    assert not (found.gaussians.object_id[scene.gaussians.object_id == 2] > 0).any()


def test_outlines_are_cut_in_views_that_are_drawn_on_the_device(device, monkeypatch):
    monkeypatch.setattr(clicks, "SCALES", SCALES[:1])
    monkeypatch.setattr(clicks, "REDUCTIONS", ())
    asked, drawn = [], []

    class Recorded(ViewFootprint):
        @classmethod
        def of(cls, scene: Scene, view: int) -> ViewFootprint:
            drawn.append(scene.gaussians.means.device.type)
            return ViewFootprint.of(scene, view)

    def refine(scene: Scene, ids: torch.Tensor, *, device: torch.device) -> torch.Tensor:
        asked.append(device.type)
        return view_outlines.refine_outlines(scene, ids, device=device)

    monkeypatch.setattr(view_outlines, "ViewFootprint", Recorded)
    monkeypatch.setattr(clicks, "refine_outlines", refine)
    scene = three_apart(side=0.56)
    found = segment(unlabelled(scene), SegmentOptions(points=(at(scene, 2, 0, "egg"),), device=device))
    assert asked == [device] and set(drawn) == {device}
    assert found.gaussians.object_id.device.type == "cpu"  # as in the whole scene


def test_points_of_one_name_are_on_one_object(monkeypatch):
    monkeypatch.setattr(clicks, "SCALES", SCALES[:1])  # one of three, each of which takes a second
    scene = three_apart(side=0.56)
    points = at(scene, 2, 0, "egg"), at(scene, 2, 5, "egg")
    found = segment(unlabelled(scene), SegmentOptions(points=points))
    assert [o.name for o in found.objects] == ["egg"]
    assert best_overlap(found.gaussians.object_id, scene.gaussians.object_id)[2] > 0.85


def test_a_point_without_an_object_is_logged_and_the_others_are_found(caplog, monkeypatch):
    monkeypatch.setattr(clicks, "SCALES", SCALES[:1])  # one of three, each of which takes a second
    scene = three_apart(side=0.56)
    corner = torch.tensor([[-0.26, 0.26, 0.0]])  # a corner of the table
    x, y = project(corner, scene.cameras.viewmats[0], scene.cameras.Ks[0])[0].tolist()
    nothing = f"xy={x:.0f},{y:.0f}"
    found = segment(unlabelled(scene), SegmentOptions(points=(nothing, at(scene, 2, 0, "egg"))))
    assert [(o.id, o.name) for o in found.objects] == [(2, "egg")] and nothing in caplog.text
    with pytest.raises(InputError, match="no object at any of the points"):
        segment(unlabelled(scene), SegmentOptions(points=(nothing,)))


@pytest.mark.parametrize("text, reason", [
    ("view=99.jpg xy=3,4", "has no photo of this name; its first photo is 00.jpg"),
    ("xy=500,20", "outside the photo, which has 160x160 pixels"),
])  # fmt: skip
def test_points_that_are_in_no_photo_are_refused(text, reason):
    with pytest.raises(InputError, match=reason):
        segment(three_apart(), SegmentOptions(points=(text,)))


@pytest.mark.parametrize("text", ["310,220", "xy=1", "view=a.jpg xy=1,2,3", "xy=1.2.3,4", "xy=nan,1"])
def test_other_forms_are_refused(text):
    with pytest.raises(InputError, match="write .view=IMG.jpg xy=310,220 name=duck"):
        parse_points((text,))


def test_one_way_of_marking_at_a_time(tmp_path):
    with pytest.raises(InputError, match="give only one of them"):
        SegmentOptions(points=("xy=1,2",), masks=tmp_path)
    with pytest.raises(InputError, match="drop --masks or --points"):
        SegmentOptions(points=("xy=1,2",), backend="sam2")
    with pytest.raises(InputError, match="has no cameras"):
        segment(three_apart(cameras=False), SegmentOptions(points=("xy=1,2",)))
