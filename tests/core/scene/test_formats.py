"""The table of file formats."""

from pathlib import Path

import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.formats import FORMATS, format_of, suffixes
from stages.core.scene.images import read_image
from stages.core.scene.trajectory import TrajectoryWriter


@pytest.mark.parametrize("entry", sorted({e for f in FORMATS.values() for e in (f.reader, f.writer) if e}))
def test_every_entry_names_a_function(entry):
    from stages.core.backends import load

    assert callable(load(entry))


def test_format_by_suffix_reads_and_writes(tmp_path):
    image = torch.rand(4, 6, 3, generator=torch.Generator().manual_seed(0))
    path = tmp_path / "a.PNG"
    format_of(path, "image", writable=True).load_writer()(path, image)
    assert torch.equal(format_of(path, "image").read(path), read_image(path))
    assert format_of(Path("traj.h5"), "scene", "trajectory").load_writer() is TrajectoryWriter


def test_only_some_images_and_videos_are_written():
    assert suffixes("image", "video", writable=True) == [".jpg", ".mp4", ".png"]


@pytest.mark.parametrize("name", ["notes.txt", "scene", "scene.ply"])
def test_other_suffixes_are_refused_with_those_that_would_do(name):
    with pytest.raises(InputError, match=rf"{name}: .* cannot be read as trajectory; use .h5, .hdf5"):
        format_of(Path(name), "trajectory")
