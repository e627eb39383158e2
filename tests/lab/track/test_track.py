"""Tracking of rendered films with known motion: poses, times of the films, lost objects and files."""

import json
from dataclasses import replace

import pytest
import torch

from ngff_cli.app import app as ngff
from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics
from stages.core.geometry.rotations import matrix, rotation_angle
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import write_labels
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.sequence import FilmedSequence
from stages.core.scene.trajectory import read_trajectory
from stages.lab.bench.track import measure, pose_errors
from stages.lab.track import stand_in as stand_in_films
from stages.lab.track.confidence import confidences, scales, tolerances
from stages.lab.track.film_masks import UNKNOWN, find_film_masks
from stages.lab.track.films import Film, list_films, read_films
from stages.lab.track.follow import TrackedMotion, Tracker, interpolated, lasting, release_time
from stages.lab.track.options import TrackOptions
from stages.lab.track.poses import Poses, rotation_of, rotation_vector
from stages.lab.track.search import half_turns, search, spread_rotations
from stages.lab.track.stand_in import (
    KEYPOINTS,
    StandIn,
    StandInOptions,
    make_stand_in,
    write_films,
    write_truth,
)
from stages.lab.track.synthesis import Synthesiser, _palette
from stages.lab.track.track import report, run
from tests.conftest import CliRunner, two_balls_scene

SMALL = StandInOptions(objects=2, cameras=4, width=160, frames=5, hidden=0, seed=8)
LATE = (0.2, -0.2, 0.1, -0.1)  # errors of the films' times in the scene file [frames]


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder with films, one of which is truncated, a scene file with wrong times, and the true motion."""
    folder = tmp_path_factory.mktemp("stand-in")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stand_in_films, "BEFORE", (2, 4))
        patch.setattr(stand_in_films, "AFTER", 2)
        stand_in = make_stand_in(SMALL)
        write_films(stand_in, folder / "films")
    write_truth(stand_in, folder / "truth.h5")
    starts = {name: start + late for (name, start), late in zip(stand_in.starts.items(), LATE, strict=True)}
    write_scene(folder / "scene.ply", replace(stand_in.scene, sequence=FilmedSequence(SMALL.fps, SMALL.frames, starts)))
    return folder, stand_in


@pytest.fixture(scope="module")
def tracked(small, device):
    """The track of these films, written by the command."""
    folder, _ = small
    words = ["track", folder / "scene.ply", folder / "films", "-o", folder / "track.h5", "--resolution", SMALL.width,
             "--keypoints", KEYPOINTS, "--seed", SMALL.seed, "--device", device]  # fmt: skip
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return read_trajectory(folder / "track.h5"), done.stdout


def test_motion_is_within_four_millimetres_and_two_degrees(small, tracked):
    folder, _ = small
    errors = pose_errors(tracked[0], read_trajectory(folder / "truth.h5"))
    assert errors.seen.all()
    assert errors.distance.median() < 0.004 and errors.angle.median() < 2
    assert errors.distance.max() < 0.01 and errors.angle.max() < 6
    assert (tracked[0].confidence > 0.8).all()


def test_times_of_the_films_are_corrected(small, tracked):
    _, stand_in = small
    found = tracked[0].scene.provenance["starts"]
    late = torch.tensor([found[name] - start for name, start in stand_in.starts.items()])
    assert (late - late.mean()).abs().max() < 0.1


def test_every_object_has_a_line(tracked):
    assert tracked[1].count("seen in 5 of 5 frames") == 2


def test_evaluate_takes_the_track_as_truth(small, tracked):
    folder, _ = small
    words = ["evaluate", folder / "truth.h5", "--against", folder / "track.h5", "-o", folder / "metrics.json"]
    done = CliRunner().invoke(ngff, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    assert json.loads((folder / "metrics.json").read_text())["overall"]["RMSE"] < 0.004


def test_films_of_other_cameras_are_refused(small, tmp_path):
    folder, _ = small
    for name in ("one.mp4", "two.mp4"):
        (tmp_path / name).write_bytes((folder / "films/camera00.mp4").read_bytes())
    with pytest.raises(InputError, match="no film of the scene's cameras"):
        list(run(folder / "scene.ply", tmp_path, tmp_path / "out.h5", TrackOptions()))


def test_scenes_without_films_or_objects_are_refused(small, tmp_path):
    folder, stand_in = small
    write_scene(tmp_path / "photos.ply", two_balls_scene())
    with pytest.raises(InputError, match="--sequence"):
        list(run(tmp_path / "photos.ply", folder / "films", tmp_path / "out.h5", TrackOptions()))
    blank = replace(stand_in.scene.gaussians, object_id=torch.zeros_like(stand_in.scene.gaussians.object_id))
    bare = Scene(blank, (), stand_in.scene.cameras, sequence=FilmedSequence(50.0, 5, stand_in.starts))
    write_scene(tmp_path / "bare.ply", bare)
    with pytest.raises(InputError, match="no objects; label"):
        list(run(tmp_path / "bare.ply", folder / "films", tmp_path / "out.h5", TrackOptions()))


def small_tracker(small, device) -> Tracker:
    folder, stand_in = small
    scene = replace(stand_in.scene, sequence=FilmedSequence(SMALL.fps, SMALL.frames, stand_in.starts))
    return Tracker(scene, *read_films(scene, list_films(scene, folder / "films"), 2, SMALL.width), device)


def test_alignment_returns_to_the_true_pose(small, device):
    tracker = small_tracker(small, device)
    still = (tracker.still, tracker.still)
    off = torch.tensor([0.1, -0.15, 0.1, 0.01, -0.01, 0.01], device=device).expand_as(tracker.still)
    found = tracker.fit(0, {8: 6, 4: 6, 2: 4}, tracker.rest.moved(off), still)
    assert (found.centre - tracker.rest.centre).norm(dim=1).max() < 0.002
    assert rotation_angle(found.rotation).max() < 2


def labels_at_the_start(stand_in: StandIn, camera: int) -> torch.Tensor:
    """The label image (h, w) of a film's first frame: ids of the objects, 0 for the background."""
    scene, synthesiser = stand_in.scene, Synthesiser(stand_in.scene, "cpu")
    size = scene.cameras.sizes[camera].tolist()
    view = synthesiser.camera(scene.cameras.viewmats[camera], scene.cameras.Ks[camera], *size)
    R = matrix(stand_in.states[0].rotation)
    centre = stand_in.states[0].com + (R @ (synthesiser.rest - stand_in.states[0].com)[..., None])[..., 0]
    return torch.tensor([0, *(o.id for o in scene.objects)])[synthesiser.draw(view, Poses(R, centre)).label + 1]


def test_label_images_alone_give_the_place(small, device):
    """Grey objects on grey are located by their label images in three of four films; the last film has none."""
    _, stand_in = small
    g = stand_in.scene.gaussians
    scene = replace(stand_in.scene, gaussians=replace(g, sh=torch.zeros_like(g.sh)))
    cameras, films = scene.cameras, []
    for i, name in enumerate(cameras.names):
        labels = torch.stack([labels_at_the_start(stand_in, i)]).to(torch.int16)
        films.append(Film(name, torch.full((*labels.shape, 3), 128, dtype=torch.uint8), 0.0, labels if i < 3 else None))
    tracker = Tracker(scene, cameras, films, device)
    off = torch.tensor([0.0, 0.0, 0.0, 0.01, -0.01, 0.01], device=device).expand_as(tracker.still)
    found = tracker.fit(0, {8: 6, 4: 6, 2: 4}, tracker.rest.moved(off), (tracker.still, tracker.still))
    pixel = 1.1 / (1.25 * SMALL.width)  # size of a pixel at the distance of the objects [m]
    assert (found.centre - tracker.rest.centre).norm(dim=1).max() < pixel / 2
    (there, _), (away, _) = (tracker.judge(0, p, (tracker.still,) * 2) for p in (found, tracker.rest.moved(off)))
    assert there.min() > 0.95 and (away < there - 0.02).all()


def test_numbers_of_label_images_are_those_of_objects(tmp_path):
    world = two_balls_scene()
    first, second = world.objects
    (tmp_path / "a").mkdir()
    (tmp_path / "names.json").write_text(json.dumps({"7": second.name}))
    write_labels(tmp_path / "a/0.png", torch.tensor([[0, first.id, 7, 255, 99]]))
    size = torch.tensor([[5, 1]])
    cameras = Cameras(torch.eye(4)[None], intrinsics(5, 1, 5.0)[None], size, ("a.mp4",))
    masks = find_film_masks(tmp_path, world, ["a.mp4", "b.mp4"])
    assert len(masks.of_film("a.mp4")) == 1 and not masks.of_film("b.mp4")
    assert masks.read(tmp_path / "a/0.png", cameras, 0, (5, 1)).tolist() == [[0, 1, 2, UNKNOWN, 0]]


def test_label_images_of_other_films_are_refused(small, tmp_path):
    folder, stand_in = small
    arguments = folder / "scene.ply", folder / "films", tmp_path / "out.h5"
    with pytest.raises(InputError, match="absent: is not a folder; --masks"):
        list(run(*arguments, TrackOptions(masks=tmp_path / "absent")))
    with pytest.raises(InputError, match="no folder of label images named like a film, such as camera00"):
        list(run(*arguments, TrackOptions(masks=tmp_path)))
    (tmp_path / "camera00").mkdir()
    write_labels(tmp_path / "camera00/0.png", torch.zeros(120, 160, dtype=torch.int64))
    with pytest.raises(InputError, match="contains 1 label images, but .*camera00.mp4 has more"):
        list(run(*arguments, TrackOptions(masks=tmp_path)))


@pytest.mark.slow
def test_a_lost_object_is_found_again(small, device):
    tracker = small_tracker(small, device)
    moved = torch.zeros_like(tracker.still)
    moved[0] = torch.tensor([1.5, 1.0, -0.5, 0.08, 0.06, -0.05])
    found = search(tracker, 0, 0, tracker.rest.moved(moved), tracker.still, 5)
    assert found is not None and found.distinct
    assert (found.poses.centre - tracker.rest.centre).norm(dim=1).max() < 0.004
    share, _ = tracker.judge(0, found.poses, (tracker.still, tracker.still))
    assert share.min() > 0.9


@pytest.mark.slow
def test_ten_cameras_with_a_hidden_object_and_a_broken_film(tmp_path, device):
    row = measure(make_stand_in(StandInOptions(width=160, frames=30, seed=101)), tmp_path, device)
    assert row["position_mm"] < 4 and row["rotation_deg"] < 2
    assert row["covered_flagged"] == row["covered"] > 5
    assert row["refined_offset_frames"] < 0.1


def test_a_rotation_and_its_vector_are_inverse():
    vector = torch.tensor([[0.3, -1.2, 0.7], [0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 3.1, 0.0]])
    torch.testing.assert_close(rotation_vector(rotation_of(vector)), vector, atol=2e-5, rtol=1e-4)


def test_spread_rotations_leave_no_gap():
    rotations, rng = spread_rotations(72), torch.Generator().manual_seed(0)
    anywhere = matrix(torch.nn.functional.normalize(torch.randn(200, 4, generator=rng), dim=1))
    nearest = rotation_angle(rotations[:, None].mT @ anywhere[None]).amin(0)
    assert nearest.max() < 60


def test_half_turns_are_about_the_principal_axes():
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([3.0, 2.0, 1.0])
    turns = half_turns(points)
    assert rotation_angle(turns).tolist() == pytest.approx([180.0] * 3, abs=0.1)
    turned = points @ turns.mT
    torch.testing.assert_close(turned.mT @ turned, (points.mT @ points).expand(3, 3, 3), rtol=1e-3, atol=1.0)


def motion(height: list[float], confidence: list[float]) -> TrackedMotion:
    """The motion of one object with these heights."""
    centre = torch.zeros(len(height), 1, 3)
    centre[:, 0, 2] = torch.tensor(height)
    share = torch.tensor(confidence)[:, None]
    return TrackedMotion(Poses(torch.eye(3).expand(len(height), 1, 3, 3), centre), share, 100 * share, {})


def test_the_release_is_where_a_fall_begins():
    fall = [max(t - 0.4, 0.0) ** 2 * 0.002 for t in range(12)]
    assert release_time(motion([1 - x for x in fall], [1.0] * 12)) == pytest.approx(0.4, abs=0.02)
    assert release_time(motion([1 - 0.001 * t for t in range(12)], [1.0] * 12)) == 0  # it does not fall freely
    assert release_time(motion([1 - x for x in fall], [1.0] + [0.0] * 11)) == 0  # it is lost immediately


def test_a_sighting_between_lost_frames_must_last():
    seen = torch.tensor([[1.0, 0, 0.9, 0.9, 0, 0.8, 0.8, 0.8, 0, 0.7]]).T
    assert lasting(seen)[:, 0].tolist() == pytest.approx([1, 0, 0, 0, 0, 0.8, 0.8, 0.8, 0, 0.7])


def test_gaps_are_interpolated():
    track = motion([0.0, 1.0, 99.0, 99.0, 4.0, 99.0], [1.0, 1.0, 0.0, 0.0, 1.0, 0.0])
    torch.testing.assert_close(interpolated(track).centre[:, 0, 2], torch.tensor([0.0, 1.0, 2.0, 3.0, 4.0, 4.0]))


def test_an_object_is_lost_unless_two_pictures_confirm_it():
    good, bad, few = torch.full((40,), 0.02), torch.full((40,), 0.5), torch.full((3,), 0.02)
    share, pixels = confidences([[good, good], [good, bad], [bad, few]], [0.1, 0.1])
    assert share.tolist() == pytest.approx([2 / 3, 0.0]) and pixels.tolist() == [120, 80]


def test_a_tolerance_is_what_few_pixels_of_a_wrong_pose_have():
    wrong = [[torch.linspace(0.0, 0.8, 81), torch.full((9,), 0.01)], [torch.zeros(0), torch.full((9,), 0.01)]]
    right = [[torch.full((9,), 0.01), torch.full((9,), 0.05)]]
    assert scales(right) == pytest.approx([0.1, 0.15])
    assert tolerances(wrong, scales(right)) == pytest.approx([0.2, 0.15])


def test_odd_colours_have_no_place_in_a_palette():
    rng = torch.Generator().manual_seed(0)
    colours = 0.9 + 0.02 * torch.randn(2000, 3, generator=rng)
    colours[:3] = torch.tensor([0.0, 0.0, 1.0])
    assert (_palette(colours) > 0.7).all()


@pytest.mark.slow
def test_objects_of_a_reconstructed_scene_are_lost_only_while_they_are_covered(tmp_path, device):
    row = measure(make_stand_in(StandInOptions(width=240, frames=26, seed=201)), tmp_path, device, "draft")
    assert row["position_mm"] < 4 and row["rotation_deg"] < 2
    assert row["covered_flagged"] == row["covered"] > 5
    assert row["others_flagged"] <= row["others"] // 10


def test_the_report_says_where_objects_were_lost():
    world = two_balls_scene()
    share = torch.tensor([[1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [1.0, 1.0]])
    pixels = torch.tensor([[50.0, 50.0], [50.0, 50.0], [50.0, 0.0], [50.0, 50.0]])
    poses = Poses(torch.eye(3).expand(4, 2, 3, 3), torch.zeros(4, 2, 3))
    lines = list(report(world, TrackedMotion(poses, share, pixels, {})))
    assert lines[0].endswith("lost in 1 to 2 (hidden or not recognised)")
    assert lines[1].endswith("lost in 2 (out of view)")
