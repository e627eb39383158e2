"""Reference frames of two files: common cameras, matched objects, and the similarity between them."""

import math
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.geometry.similarity import Similarity
from stages.core.scene.scene import SceneObject
from stages.evaluate.align import ReferenceFrame, check_same_reference_frame, find_alignment
from stages.evaluate.matching import match_objects, object_labels
from tests.conftest import ring

BALL, DUCK, CUP = SceneObject(1, "ball"), SceneObject(2, "duck"), SceneObject(3, "cup")
SHIFT = torch.tensor([0.0, 1.0, 0.0])


def objects_at(objects, places, file="mine.h5") -> ReferenceFrame:
    """Objects with two points each, at 0.5 from their centre."""
    half = torch.tensor([[0.5, 0, 0], [-0.5, 0, 0]])
    points = {o.id: torch.tensor(place) + half for o, place in zip(objects, places, strict=True)}
    return ReferenceFrame(file, None, tuple(objects), points)


def cameras_of(cameras, file="mine.h5", **more) -> ReferenceFrame:
    return ReferenceFrame(file, cameras, (), {}, **more)


@pytest.mark.parametrize(("shift", "same"), [(0.0, True), (0.19, True), (0.21, False)])
def test_shared_cameras_a_tenth_of_their_radius_apart_are_in_another_frame(shift, same):
    """The cameras' radius is 2 cos 25 degrees; only the distance of the cameras counts, not that of the objects."""
    true = ring()
    moved = true.transformed(Similarity(1.0, torch.eye(3), shift * math.cos(math.radians(25)) * SHIFT))
    far = objects_at([BALL], [(99.0, 0, 0)])
    mine, truth = replace(far, cameras=moved), replace(objects_at([BALL], [(0.0, 0, 0)], "true.h5"), cameras=true)
    with (
        nullcontext()
        if same
        else pytest.raises(InputError, match="mine.h5: has a different frame .* than true.h5 .cameras")
    ):
        check_same_reference_frame(mine, truth, [(BALL, BALL)])


def test_cameras_of_other_names_are_not_shared():
    frame = ReferenceFrame("a", ring(count=3), (), {})
    other = replace(frame, cameras=replace(frame.cameras, names=("x.png", "y.png", "z.png")))
    check_same_reference_frame(frame, other, [])  # nothing can distinguish the frames
    with pytest.raises(InputError, match="fewer than two camera names and fewer than two object names in common"):
        find_alignment(frame, other)


def test_cameras_correspond_by_name_without_suffix():
    true = ring(count=3)
    other = replace(true[[2, 0, 1]], names=("02.jpg", "00.jpg", "else.jpg"))
    away = Similarity(0.5, torch.eye(3), SHIFT)
    found, how = find_alignment(cameras_of(other.transformed(away.inverse())), cameras_of(true))
    assert how == "aligned by 2 cameras with the same names"
    torch.testing.assert_close(found.translation, SHIFT, atol=1e-5, rtol=0)
    assert found.scale == pytest.approx(0.5, abs=1e-6) and found.rotation.dtype == torch.float32
    check_same_reference_frame(cameras_of(other), cameras_of(true), [])


def test_one_shared_camera_does_not_locate_a_frame():
    true = ring(count=2)
    alone = replace(true, names=("00.png", "else.png"), viewmats=true.viewmats.flip(0))
    places = [(0.0, 0, 0), (2.0, 0, 0)]
    mine = replace(objects_at([DUCK, BALL], places), cameras=alone)
    truth = replace(objects_at([BALL, DUCK], [(4.0, 0, 0), (0.0, 0, 0)], "true.h5"), cameras=true)
    found, how = find_alignment(mine, truth)
    assert how == "aligned by the centres of ball, duck, keeping the vertical" and found.scale == pytest.approx(2)
    check_same_reference_frame(cameras_of(alone), cameras_of(true), [])  # the frames are unknown
    with pytest.raises(InputError, match="mine.h5 and true.h5 have fewer than two camera names and fewer than two obj"):
        find_alignment(cameras_of(alone), cameras_of(true, "true.h5"))
    one = objects_at([BALL], places[:1])
    with pytest.raises(InputError, match="fewer than two"):
        find_alignment(one, one)


def test_upright_alignment_is_the_least_squares_one():
    """The centres do not correspond exactly; near rotations about the vertical, scales and shifts are worse."""
    rng = torch.Generator().manual_seed(0)
    source, target = torch.randn(2, 3, 3, generator=rng)
    target = 2 * source @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + 0.3 * target + 5
    objects = [BALL, DUCK, CUP]
    frames = [objects_at(objects, p.tolist()) for p in (source, target)]
    found, _ = find_alignment(*frames)
    best = (found(source) - target).square().sum()
    for angle, scale, shift in ((0.02, 1, 0), (-0.02, 1, 0), (0, 1.02, 0), (0, 0.98, 0), (0, 1, 0.05), (0, 1, -0.05)):
        c, s = math.cos(angle), math.sin(angle)
        R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ found.rotation
        centre = found(source).mean(0)
        near = Similarity(scale * found.scale, R, centre - scale * found.scale * R @ source.mean(0) + shift)
        assert (near(source) - target).square().sum() > best
    torch.testing.assert_close(found.rotation[2], torch.tensor([0.0, 0, 1]))


def test_centres_that_do_not_correspond_are_refused():
    mine, truth = (
        objects_at([BALL, DUCK], [(0.0, 0, 0), (0.0, 0, 1)]),
        objects_at([BALL, DUCK], [(0.0, 0, 1), (0.0, 0, 0)]),
    )
    with pytest.raises(InputError, match="the centres of the objects in the two files do not correspond"):
        find_alignment(mine, truth)  # one of them is upside down


def test_cameras_at_one_position_have_no_scale():
    one = replace(ring(count=2), viewmats=ring(count=1).viewmats.expand(2, 4, 4))
    assert torch.equal(*centres(one.viewmats))
    with pytest.raises(InputError, match="the scale is undetermined"):
        find_alignment(cameras_of(one), cameras_of(ring(count=2)))


def names_of(pairs):
    return [(a.name, b.name) for a, b in pairs]


def test_objects_are_matched_by_name_in_the_order_of_the_truth():
    mine, truth = objects_at([DUCK, CUP, BALL], [(0.0, 0, 0)] * 3), objects_at([BALL, DUCK], [(0.0, 0, 0)] * 2, "true")
    pairs, how = match_objects(mine, truth, ["ball", "duck"])
    assert names_of(pairs) == [("ball", "ball"), ("duck", "duck")] and "by name" in how
    for names in ([], ["cow"]):
        with pytest.raises(InputError, match="has 3 objects|--objects cow: true has ball, duck"):
            match_objects(mine, truth, names)
    with pytest.raises(InputError, match="has no objects to compare"):
        match_objects(mine, objects_at([], []), [])


def test_other_names_are_matched_by_the_smallest_sum_of_distances():
    """The nearest match of the first object would leave a distant one for the second."""
    truth = objects_at([BALL, DUCK], [(0.0, 0, 0), (2.0, 0, 0)])
    a, b = SceneObject(1, "a"), SceneObject(2, "b")
    mine = objects_at([a, b], [(-9.0, 0, 0), (0.5, 0, 0)])
    pairs, how = match_objects(mine, truth, [])
    assert names_of(pairs) == [("a", "ball"), ("b", "duck")] and how.startswith("objects were matched by id")
    swapped = replace(mine, objects=(replace(a, id=2), replace(b, id=1)), points={2: mine.points[1], 1: mine.points[2]})
    pairs, how = match_objects(swapped, truth, [])
    assert (
        names_of(pairs) == [("a", "ball"), ("b", "duck")] and "nearest centre" in how and "(a = ball, b = duck)" in how
    )


def test_names_that_occur_twice_do_not_match_and_are_told_apart():
    two = [BALL, replace(BALL, id=5), DUCK]
    assert object_labels(two) == ["ball 1", "ball 5", "duck"]
    truth = objects_at(two, [(0.0, 0, 0), (1.0, 0, 0), (2.0, 0, 0)])
    mine = objects_at([BALL, DUCK, replace(BALL, id=5)], [(1.1, 0, 0), (2.1, 0, 0), (0.1, 0, 0)])
    pairs, how = match_objects(mine, truth, [])
    assert [a.id for a, _ in pairs] == [5, 1, 2] and "nearest centre" in how
