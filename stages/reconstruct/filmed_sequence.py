"""Input from films of several fixed cameras: the frame of each film at the release, as photos, and its time."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np

from stages.core.errors import InputError
from stages.core.scene.images import import_av, open_video
from stages.core.scene.recordings import common_frame_rate, list_recordings, read_recording
from stages.core.scene.schema import reason
from stages.core.scene.sequence import FilmedSequence
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photo_reader import MAX_SIDES
from stages.reconstruct.photos import Photos
from stages.reconstruct.synchronise import MotionSignal, find_motion, find_offsets, motion_signal, parse_offsets

log = logging.getLogger(__name__)
MOTION_SIDE = 64  # longest side of the frames in which motion is measured [px]
SOUND_RATE = 48_000  # sampling rate to which sound is converted [Hz]
LOUDNESS_RATE = 10  # loudness values per frame
MAX_LATE = 600  # largest delay between sound and pictures, in either direction [s]


def read_sequence(folder: Path, options: ReconstructOptions) -> tuple[Photos, FilmedSequence]:
    """Read the frame of each film at the release, and synchronise the films.

    Raises InputError for a folder without films, films that cannot be synchronised, and films without motion.
    """
    recordings = list_recordings(folder)
    fps = common_frame_rate(recordings, options.fps)
    signals = {name: _signal(path) for name, path in recordings.items()}
    if options.offsets:
        offsets = parse_offsets(options.offsets, list(recordings))
    elif options.sync == "audio":
        offsets = find_offsets({name: loudness(path, fps) for name, path in recordings.items()}, LOUDNESS_RATE)
    else:
        offsets = find_offsets({name: signal.share for name, signal in signals.items()})
    release, rest = find_motion(signals, offsets)
    starts = {name: offset + release for name, offset in offsets.items()}
    lengths = {name: len(signals[name].share) + 1 for name in starts}
    if missed := [name for name, start in starts.items() if not 0 <= start < lengths[name]]:
        log.warning("%s: left out, as the film does not show the release of the objects", ", ".join(missed))
        starts = {name: start for name, start in starts.items() if name not in missed}
    if len(starts) < 2:
        raise InputError(
            f"{folder}: fewer than two films show the release of the objects; give films that begin before it"
        )
    # a track needs two films, so the sequence ends with the second longest film after the release
    shown = sorted(lengths[name] - start for name, start in starts.items())[-2]
    sequence = FilmedSequence(fps, max(1, math.ceil(min(rest - release + 1, shown))), starts)
    for name, start in starts.items():
        log.info("%s: the objects are released at frame %.2f", name, start)
    log.info("%d frames from release to rest, at %g frames per second", sequence.frames, fps)
    return _first_frames(folder, recordings, starts, options), sequence


def _signal(path: Path) -> MotionSignal:
    frames = [image.numpy() for image, _ in read_recording(path, MOTION_SIDE)]
    if len(frames) < 2:
        raise InputError(f"{path}: has fewer than two readable frames; give a film that begins before the release, or "
                         "remove it")  # fmt: skip
    return motion_signal(frames)


def _first_frames(
    folder: Path, recordings: dict[str, Path], starts: dict[str, float], options: ReconstructOptions
) -> Photos:
    """The last frame of each film before the release."""
    images, sizes = [], []
    for name, start in starts.items():
        frames = read_recording(recordings[name], max(options.max_side, MAX_SIDES[0]))
        image, size = next(frame for k, frame in enumerate(frames) if k == int(start))
        images.append(image)
        sizes.append(size)
    return Photos(tuple(images), tuple(starts), (0.0,) * len(images), Path(folder), tuple(sizes))


def loudness(path: Path, fps: float) -> np.ndarray:
    """Logarithm of the loudness of a video's sound: LOUDNESS_RATE values per frame, from the first frame on.

    Raises InputError for a recording without sound or with damaged sound.
    """
    if not path.is_file():
        raise InputError(f"{path}: is a folder of frames and has no sound; use --sync motion")
    with open_video(path) as file:
        if not file.streams.audio:
            raise InputError(f"{path}: has no sound; use --sync motion")
        av = import_av(path)
        resampler = av.AudioResampler(format="flt", layout="mono", rate=SOUND_RATE)
        try:
            parts = [out.to_ndarray()[0] for frame in file.decode(audio=0) for out in resampler.resample(frame)]
        except (av.FFmpegError, ValueError) as error:
            raise InputError(f"{path}: its sound cannot be read ({reason(error)}); use --sync motion") from error
        video, audio = (s.start_time or 0 for s in (file.streams.video[0], file.streams.audio[0]))
        late = float(audio * file.streams.audio[0].time_base - video * file.streams.video[0].time_base)
    if abs(late) > MAX_LATE:
        raise InputError(f"{path}: its sound begins {late:.0f} s after its first frame; use --sync motion")
    samples = np.concatenate(parts) if parts else np.zeros(0, np.float32)
    shift = round(late * SOUND_RATE)
    samples = np.pad(samples, (shift, 0)) if shift > 0 else samples[-shift:]
    edges = np.arange(0, len(samples), SOUND_RATE / fps / LOUDNESS_RATE).astype(int)
    energy = np.add.reduceat(np.square(samples), edges) / np.diff([*edges, len(samples)]) if len(edges) else edges
    return np.log(energy + 1e-6)
