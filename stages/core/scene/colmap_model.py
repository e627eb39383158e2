"""Read the cameras and images of a COLMAP model (.bin or .txt); its points are not read.

Source of the layout: https://colmap.github.io/format.html and src/colmap/scene/reconstruction_io.cc of COLMAP.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.core.scene.schema import LARGEST, quote

MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
          "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")  # fmt: skip
FOCALS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
LENS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8}
MAX_NAME = 1000  # longest image name [bytes]
MAX_TEXT = 1 << 30  # largest text file [bytes]


@dataclass(frozen=True)
class ColmapImage:
    """A registered image."""

    name: str
    viewmat: np.ndarray  # (4, 4) world to camera
    K: np.ndarray  # (3, 3) [px]
    size: tuple[int, int]  # width, height [px]
    lens: tuple[float, ...]  # k1 k2 p1 p2 k3 k4 k5 k6


def read_colmap(folder: Path) -> list[ColmapImage]:
    """The images of a COLMAP model with their cameras, sorted by name.

    Raises ValueError for damaged files and for camera models that are not in FOCALS, and FileNotFoundError.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    cameras = _cameras_bin(folder / "cameras.bin") if binary else _cameras_txt(folder / "cameras.txt")
    rows = _images_bin(folder / "images.bin") if binary else _images_txt(folder / "images.txt")
    images = []
    for name, pose, camera in sorted(rows):
        if camera not in cameras:
            raise ValueError(f"{quote(name)} has camera {camera}, which is not among the cameras")
        images.append(ColmapImage(quote(Path(name).name, 255), _viewmat(pose, name), *cameras[camera]))
    return images


class _Bytes:
    """Sequential reader of packed little-endian values. Raises ValueError for reads beyond the end of the file."""

    def __init__(self, path: Path):
        self.name, self.data, self.at = path.name, path.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        if self.at + size > len(self.data):
            raise ValueError(f"{self.name} is truncated")
        self.at += size
        return struct.unpack_from("<" + layout, self.data, self.at - size)

    def count(self, smallest: int) -> int:
        """Read a number of rows, each of at least `smallest` bytes."""
        (n,) = self.take("Q")
        if n * smallest > len(self.data) - self.at:
            raise ValueError(f"{self.name} declares {n} rows, but has {len(self.data)} bytes")
        return n

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + MAX_NAME)
        if end < 0:
            raise ValueError(f"{self.name} has a name without an end")
        self.at, start = end + 1, self.at
        return self.data[start:end].decode(errors="replace")


def _cameras_bin(path: Path) -> dict[int, tuple]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(24)):
        id, number, width, height = file.take("IiQQ")
        model = MODELS[number] if 0 <= number < len(MODELS) else f"number {number}"
        cameras[id] = _camera(model, width, height, file.take(f"{_length(model)}d"))
    return cameras


def _images_bin(path: Path) -> list[tuple[str, tuple, int]]:
    file, rows = _Bytes(path), []
    for _ in range(file.count(65)):
        _, *pose, camera = file.take("I7dI")
        rows.append((file.text(), tuple(pose), camera))
        features = file.count(24)  # x, y and point id of each feature
        file.at += 24 * features
    return rows


def _lines(path: Path) -> list[str]:
    if path.stat().st_size > MAX_TEXT:
        raise ValueError(f"{path.name} has more than {MAX_TEXT >> 20} MB")
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line for line in lines if not line.startswith("#")]


def _cameras_txt(path: Path) -> dict[int, tuple]:
    cameras = {}
    for line in filter(str.strip, _lines(path)):
        id, model, width, height, *parameters = line.split()
        if len(parameters) != _length(model):
            raise ValueError(f"{path.name} has the line {quote(line)}")
        cameras[int(id)] = _camera(model, int(width), int(height), tuple(map(float, parameters)))
    return cameras


def _images_txt(path: Path) -> list[tuple[str, tuple, int]]:
    rows, lines = [], _lines(path)
    if wrong := next((line for line in lines[1::2] if len(line.split()) % 3), None):
        raise ValueError(f"{path.name} has the line {quote(wrong)} in place of an image's features, or an empty line")
    for line in lines[::2]:  # every second line has the features, x y and a point, and may be empty
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise ValueError(f"{path.name} has the line {quote(line)}")
        rows.append((words[9].strip(), tuple(map(float, words[1:8])), int(words[8])))
    return rows


def _length(model: str) -> int:
    """Number of parameters of a camera model. Raises ValueError unless its lens can be undistorted."""
    if model not in FOCALS:
        raise ValueError(f"camera model {quote(model, 40)} is not supported; undistort it with `colmap "
                         "image_undistorter`")  # fmt: skip
    return FOCALS[model] + 2 + LENS[model]


def _camera(model: str, width: int, height: int, parameters: tuple[float, ...]) -> tuple:
    """K, size and lens from COLMAP's parameters: f or fx fy, then cx cy, then the lens."""
    f = FOCALS[model]
    focals, (cx, cy), lens = parameters[:f], parameters[f : f + 2], parameters[f + 2 :]
    if not all(-LARGEST <= x <= LARGEST for x in parameters):
        raise ValueError("a camera has a parameter that is not finite, or far too large")
    K = np.array([[focals[0], 0, cx], [0, focals[-1], cy], [0, 0, 1]])
    return K, (width, height), (*lens, *[0.0] * (8 - len(lens)))


def _viewmat(pose: tuple[float, ...], name: str) -> np.ndarray:
    """World to camera from a quaternion w x y z and a translation."""
    norm = float(np.linalg.norm(pose[:4])) if all(-LARGEST <= v <= LARGEST for v in pose) else 0.0
    if not norm > 1e-6:
        raise ValueError(f"the pose of {quote(name)} is not finite, or its quaternion is zero")
    w, x, y, z = np.array(pose[:4]) / norm
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                       [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                       [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    viewmat[:3, 3] = pose[4:]
    return viewmat
