"""Synchronisation of films by motion, by sound and by given times, and the frames at the release."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.images import VideoWriter, read_image, write_png
from stages.core.scene.recordings import common_frame_rate, list_recordings, read_recording
from stages.core.scene.scene_ply import read_scene
from stages.reconstruct.filmed_sequence import loudness, read_sequence
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import run
from stages.reconstruct.synchronise import find_motion, find_offsets, motion_signal, parse_offsets
from tests.reconstruct.raycast import arc, write_set

SIZE = 64  # side of the films [px]
STARTS = {"a": 8.0, "b": 12.0 + 1 / 3, "c": 6.0 + 2 / 3}  # frame of each film at which the object is released
FALL, LANDING, REST = 0.35, 12, 24  # acceleration [px/frame^2]; frames from the release to the first and second landing


def picture(time: float, view: int) -> np.ndarray:
    """Image (h, w, 3), 0..255, of a patterned disc that falls from time 0, rebounds and lands, from one camera."""
    t = min(max(time, 0.0), REST)
    middle = (LANDING + REST) / 2  # of the rebound, whose height is half of that of the fall
    height = t**2 if t < LANDING else LANDING**2 / 2 * (1 + ((t - middle) / (REST - middle)) ** 2)
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    cx, cy = 20 + 10 * view, 14 + FALL * height / 2
    inside = np.clip(10.5 - np.hypot(x - cx, y - cy), 0, 1)
    pattern = 0.5 + 0.4 * np.sin(0.9 * (x - cx) + view) * np.cos(0.8 * (y - cy))
    grey = (1 - inside) * 0.4 + inside * pattern
    return np.repeat((255 * grey)[..., None], 3, 2)


def film(view: int, start: float, count: int = 48, noise: float = 1.0) -> list[np.ndarray]:
    rng = np.random.default_rng(view)
    frames = (picture(k - start, view) + noise * rng.standard_normal((SIZE, SIZE, 3)) for k in range(count))
    return [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]


@pytest.fixture(scope="module")
def films() -> dict[str, list[np.ndarray]]:
    return {name: film(view, start) for view, (name, start) in enumerate(STARTS.items())}


def write_frames(folder: Path, films: dict[str, list[np.ndarray]]) -> Path:
    """Write the films as folders of frames."""
    for name, frames in films.items():
        (folder / name).mkdir(parents=True)
        for k, frame in enumerate(frames):
            write_png(folder / name / f"{k:04d}.png", torch.from_numpy(frame).float() / 255)
    return folder


def test_films_of_different_views_are_synchronised_within_fractions_of_a_frame(films):
    signals = {name: motion_signal(frames) for name, frames in films.items()}
    offsets = find_offsets({name: signal.share for name, signal in signals.items()})
    late = np.array([offsets[name] - start for name, start in STARTS.items()])
    assert np.abs(late - late.mean()).max() < 0.35
    release, rest = find_motion(signals, offsets)
    assert release == pytest.approx(STARTS["a"], abs=0.5)
    assert rest == pytest.approx(STARTS["a"] + REST, abs=1.0)


def test_a_film_of_another_motion_is_left_out(films, caplog):
    rng = np.random.default_rng(0)
    signals = {name: motion_signal(frames).share for name, frames in films.items()}
    signals["other"] = 0.01 * rng.random(47)
    assert set(find_offsets(signals)) == set(STARTS)
    assert "other" in caplog.text


def test_films_without_motion_are_refused():
    still = {name: motion_signal(film(view, 1000.0)) for view, name in enumerate("ab")}
    with pytest.raises(InputError, match="no common motion"):
        find_offsets({name: signal.share for name, signal in still.items()})


def test_the_frames_at_the_release_are_the_photos(films, tmp_path):
    folder = write_frames(tmp_path / "cameras", films)
    photos, sequence = read_sequence(folder, ReconstructOptions(sequence=True, fps=50.0))
    assert photos.names == ("a", "b", "c") and sequence.fps == 50
    for name, image, view in zip(photos.names, photos.images, range(3), strict=True):
        assert sequence.starts[name] == pytest.approx(STARTS[name], abs=0.6)
        assert np.abs(image.numpy() - picture(0, view)).mean() < 4  # nothing has moved yet, apart from the noise
    assert REST <= sequence.frames <= REST + 3


def test_a_film_of_one_frame_is_named(films, tmp_path):
    folder = write_frames(tmp_path / "cameras", {**films, "b": films["b"][:1]})
    with pytest.raises(InputError, match="b: has fewer than two readable frames"):
        read_sequence(folder, ReconstructOptions(sequence=True, offsets="a=0,b=0,c=0"))


def test_offsets_may_be_given(films, tmp_path):
    folder = write_frames(tmp_path / "cameras", films)
    given = ",".join(f"{name}={start}" for name, start in STARTS.items())
    _, sequence = read_sequence(folder, ReconstructOptions(sequence=True, offsets=given))
    assert sequence.starts["b"] - sequence.starts["a"] == pytest.approx(STARTS["b"] - STARTS["a"], abs=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [("a=0", "b is missing"), ("a=0,b=1,z=2", "z is not a film"), ("a=0,b=x", "write NAME=FRAME,"), ("a,b", "write"),
     ("a=0,b=nan", "finite")],
)  # fmt: skip
def test_wrong_offsets_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_offsets(text, ["a", "b"])


def test_films_of_different_rates_are_refused(tmp_path):
    for name, fps in (("a.mp4", 50.0), ("b.mp4", 25.0)):
        with VideoWriter(tmp_path / name, fps) as video:
            for _ in range(3):
                video.append(torch.zeros(16, 16, 3))
    recordings = list_recordings(tmp_path)
    with pytest.raises(InputError, match="same frame rate"):
        common_frame_rate(recordings, 50.0)
    assert [image.shape for image, _ in read_recording(recordings["a.mp4"], 8)] == [(8, 8, 3)] * 3


def test_one_film_is_too_few(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="two cameras or more"):
        list_recordings(tmp_path)


def test_sequence_options_need_sequence():
    with pytest.raises(InputError, match="only work with --sequence"):
        ReconstructOptions(offsets="a=0,b=1")
    with pytest.raises(InputError, match="only work with --sequence"):
        ReconstructOptions(fps=30.0)
    with pytest.raises(InputError, match="--sync"):
        ReconstructOptions(sequence=True, sync="smell")


def write_clap(path: Path, start: float, fps: int = 25, seconds: float = 1.2) -> None:
    """Write a video with a short noise at frame `start` and a quiet hiss otherwise."""
    av = pytest.importorskip("av")
    rate, rng = 48_000, np.random.default_rng(len(path.name))
    sound = 0.002 * rng.standard_normal(int(seconds * rate))
    onset = int(start / fps * rate)
    sound[onset : onset + rate // 10] += 0.5 * rng.standard_normal(rate // 10) * np.exp(-np.arange(rate // 10) / 800)
    with av.open(str(path), "w") as file:
        video = file.add_stream("libx264", rate=fps)
        video.width, video.height, video.pix_fmt = 16, 16, "yuv420p"
        audio = file.add_stream("pcm_s16le", rate=rate)
        for _ in range(int(seconds * fps)):
            file.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), format="rgb24")))
        file.mux(video.encode())
        samples = (np.clip(sound, -1, 1) * 32767).astype(np.int16)[None]
        frame = av.AudioFrame.from_ndarray(samples, format="s16", layout="mono")
        frame.sample_rate, frame.time_base = rate, Fraction(1, rate)
        file.mux(audio.encode(frame))
        file.mux(audio.encode())


def test_films_are_synchronised_by_sound(tmp_path):
    starts = {"a.mkv": 8.0, "bb.mkv": 11.4}
    for name, start in starts.items():
        write_clap(tmp_path / name, start)
    offsets = find_offsets({name: loudness(tmp_path / name, 25) for name in starts}, 10)
    assert offsets["bb.mkv"] == pytest.approx(3.4, abs=0.05)


def write_sound(path: Path, codec: str, packet: bytes, late: float = 0.0) -> None:
    """Write a film of one frame whose sound is one packet that begins later [s]."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as file:
        video, audio = file.add_stream("libx264", rate=25), file.add_stream(codec, rate=48_000)
        video.width, video.height, video.pix_fmt = 16, 16, "yuv420p"
        file.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), format="rgb24")))
        file.mux(video.encode())
        sound = av.Packet(packet)
        sound.stream, sound.time_base = audio, Fraction(1, 1000)
        sound.pts = sound.dts = int(1000 * late)
        file.mux(sound)


def test_damaged_and_very_late_sound_is_named(tmp_path):
    write_sound(tmp_path / "a.mkv", "flac", b"no FLAC" * 20)
    with pytest.raises(InputError, match="a.mkv: its sound cannot be read .*use --sync motion"):
        loudness(tmp_path / "a.mkv", 25)
    write_sound(tmp_path / "b.mov", "pcm_s16le", bytes(200), late=10_000.0)
    with pytest.raises(InputError, match="b.mov: its sound begins 10000 s after its first frame; use --sync motion"):
        loudness(tmp_path / "b.mov", 25)


def test_frames_have_no_sound(tmp_path):
    with pytest.raises(InputError, match="no sound"):
        loudness(tmp_path, 25)


def test_the_scene_of_the_release_has_the_times_of_the_films(tmp_path):
    """The scene is static; something crosses the image from a frame that differs between the films."""
    pytest.importorskip("pycolmap")
    cameras = write_set(tmp_path / "set", arc(4, (96, 72), sweep=40.0))
    for view, photo in enumerate(sorted((tmp_path / "set/images").iterdir())):
        folder = tmp_path / "films" / photo.name
        folder.mkdir(parents=True)
        image = read_image(photo)
        for k in range(30):
            t = min(max(k - 6 - view, 0), 12)
            frame = image.clone()
            frame[int(2 + 0.2 * t**2) :][:8, 40:56] = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0))
            write_png(folder / f"{k:03d}.png", frame)
    options = ReconstructOptions(sequence=True, cameras=cameras, quality="draft", iterations=0)
    run(tmp_path / "films", tmp_path / "scene.ply", options)
    scene = read_scene(tmp_path / "scene.ply")
    assert scene.sequence.fps == 50 and len(scene.cameras) == 4
    for view, name in enumerate(scene.cameras.names):
        assert 8 + view - 0.5 < scene.sequence.starts[name] < 9 + view + 0.5  # the first frames that differ
