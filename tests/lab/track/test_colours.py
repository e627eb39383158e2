"""Colours of sides that are not visible in the first frame are learned from later frames."""

import math
from dataclasses import replace

import pytest
import torch

from stages.core.geometry.cameras import centres, intrinsics, look_at
from stages.core.geometry.rotations import rotation_angle
from stages.core.geometry.similarity import Similarity
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, transformed
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.toys import falling_toys
from stages.lab.track import follow
from stages.lab.track.films import Film
from stages.lab.track.follow import Tracker, first_pass
from stages.lab.track.poses import Poses, rotation_of
from stages.lab.track.stand_in import thinned

WIDTH, HEIGHT, FRAMES = 128, 96, 11
GREY = (0.5, 0.5, 0.5)


def painted_ball() -> Gaussians:
    """The ball of the toys with its sectors of six colours, centred at the origin."""
    g = falling_toys().gaussians
    g = thinned(g[g.object_id == 1])
    means = g.means - (g.means.amin(0) + g.means.amax(0)) / 2
    return replace(g, means=means, sh=g.sh[:, :1], object_id=torch.ones_like(g.object_id))


@pytest.fixture(scope="module")
def turning():
    """A ball that rotates by 180 degrees, its films by three cameras on one side, the cameras and the rotations."""
    g, rng = painted_ball(), torch.Generator().manual_seed(0)
    azimuth = torch.linspace(-0.5, 0.5, 3)
    eyes = torch.stack([0.5 * azimuth.cos(), 0.5 * azimuth.sin(), torch.linspace(0.1, 0.3, 3)], 1)
    viewmats, K = look_at(eyes, torch.zeros_like(eyes)), intrinsics(WIDTH, HEIGHT, 1.3 * WIDTH)
    names = tuple(f"{i}.mp4" for i in range(3))
    cameras = Cameras(viewmats, K.expand(3, 3, 3).clone(), torch.tensor([[WIDTH, HEIGHT]] * 3), names)
    turns = rotation_of(torch.linspace(0, math.pi, FRAMES)[:, None] * torch.tensor([0.0, 0.0, 1.0]))
    films = []
    for name, V in zip(names, viewmats, strict=True):
        frames = []
        for turn in turns:
            now = transformed(g, Similarity(1.0, turn, torch.zeros(3)))
            image = rasterise(now, V[None], K[None], WIDTH, HEIGHT, torch.tensor(GREY)).rgb[0]
            noisy = image + 0.02 * torch.randn(image.shape, generator=rng)
            frames.append((255 * noisy.clamp(0, 1)).round().to(torch.uint8))
        films.append(Film(name, torch.stack(frames), 0.0))
    return g, films, cameras, turns


def far_side(g: Gaussians, cameras: Cameras) -> torch.Tensor:
    """Rows of the Gaussians that no camera sees in the first frame, because they face away from all."""
    return (g.means @ centres(cameras.viewmats).T < 0).all(1).nonzero()[:, 0]


def half_known(turning, device) -> Tracker:
    """A tracker of the ball in which the far side has the mean colour of all Gaussians."""
    g, films, cameras, _ = turning
    sh = g.sh.clone()
    sh[far_side(g, cameras)] = sh.mean(0)
    scene = Scene(replace(g, sh=sh), (SceneObject(1, "ball"),), cameras, background=GREY)
    return Tracker(scene, cameras, films, device)


def true_poses(tracker: Tracker, turns: torch.Tensor, frame: int) -> Poses:
    """The true poses in a frame."""
    turn = turns[frame].to(tracker.device)
    return Poses(turn[None], (turn @ tracker.rest.centre[0])[None])


def colour_error(tracker: Tracker, g: Gaussians, cameras: Cameras) -> float:
    """Mean difference of the far side's colours from the true ones, as an SH coefficient."""
    off = tracker.synthesiser.rest_gaussians.sh.cpu() - g.sh
    return float(off[far_side(g, cameras)].abs().mean())


def test_the_far_side_of_a_ball_is_not_known(turning, device):
    g, _, cameras, _ = turning
    known = half_known(turning, device).colours.known.cpu()
    assert not known[far_side(g, cameras)].any()
    assert known[g.means[:, 0] > 0.7 * g.means[:, 0].max()].float().mean() > 0.95


def test_a_ball_is_followed_by_colours_that_it_shows_later(turning, device, monkeypatch):
    g, _, cameras, turns = turning
    monkeypatch.setattr(follow, "search", lambda *_: None)  # lost objects are not searched for
    lost, worst = [], []
    for learning in (True, False):
        tracker = half_known(turning, device)
        if not learning:
            monkeypatch.setattr(tracker, "learn", lambda *_: None)
        before = colour_error(tracker, g, cameras)
        track = first_pass(tracker, FRAMES, torch.zeros(3, device=device))
        lost.append(int((track.confidence == 0).sum()))
        worst.append(float(rotation_angle(track.poses.rotation[:, 0].cpu() @ turns.mT).max()))
        assert (colour_error(tracker, g, cameras) < 0.7 * before) == learning
    assert lost[0] == 0 and worst[0] < 6
    assert lost[1] >= 4 and worst[1] > 30


def test_nothing_is_learned_of_lost_objects_and_from_pictures_that_disagree(turning, device):
    g, films, cameras, turns = turning
    tracker, still = half_known(turning, device), torch.zeros(1, 6, device=device)
    before, half = colour_error(tracker, g, cameras), FRAMES // 2
    yes, no = torch.tensor([True], device=device), torch.tensor([False], device=device)
    for frame in range(half - 3, half + 1):
        tracker.learn(frame, true_poses(tracker, turns, frame), (still, still), no)
    assert colour_error(tracker, g, cameras) == before
    # something dark is in front of the ball
    tracker.films = [replace(film, frames=film.frames * 0 + 20) for film in films]
    for frame in range(half - 3, half + 1):
        tracker.learn(frame, true_poses(tracker, turns, frame), (still, still), yes)
    assert colour_error(tracker, g, cameras) == before
    tracker.films = films
    for frame in range(half - 3, half + 1):
        tracker.learn(frame, true_poses(tracker, turns, frame), (still, still), yes)
    assert colour_error(tracker, g, cameras) < 0.9 * before


def test_one_frame_with_something_else_in_it_does_not_matter(turning, device, monkeypatch):
    """The reason is the median over frames; here, images need not agree with known colours."""
    g, _, cameras, turns = turning
    errors, yes = [], torch.tensor([True], device=device)
    for odd in (None, 2):
        tracker, still = half_known(turning, device), torch.zeros(1, 6, device=device)
        monkeypatch.setattr(tracker.colours, "_agrees", lambda found: yes)
        for k in range(5):
            pictures = tracker.observe(FRAMES // 2, 1, still, still)
            if k == odd:
                pictures = [replace(o, image=1 - o.image) for o in pictures]
            tracker.colours.learn(pictures, true_poses(tracker, turns, FRAMES // 2), yes)
        errors.append(colour_error(tracker, g, cameras))
    assert errors[1] == pytest.approx(errors[0], rel=0.1)


def test_colours_that_were_right_stay(turning, device):
    g, films, cameras, turns = turning
    tracker = Tracker(Scene(g, (SceneObject(1, "ball"),), cameras, background=GREY), cameras, films, device)
    still, yes = torch.zeros(1, 6, device=device), torch.tensor([True], device=device)
    for frame in range(1, FRAMES):
        tracker.learn(frame, true_poses(tracker, turns, frame), (still, still), yes)
    assert colour_error(tracker, g, cameras) < 0.05 * float(g.sh.std())
