"""Fixtures that read recorded outputs of the published code, and the names and shapes of its weights."""

import json

import numpy as np
import pytest
import torch

CLOSE = {"rtol": 1e-4, "atol": 1e-5}  # tolerances stated with the recordings


@pytest.fixture
def recorded(shared):
    """Function that reads one recording: inputs, outputs and state dict."""

    def read(name: str) -> tuple[dict, dict, dict]:
        data = np.load(shared / "facts/pi3_parity" / f"{name}.npz")
        parts = {"in": {}, "out": {}, "w": {}}
        for key in data:
            kind, _, rest = key.partition("/")
            parts[kind][rest] = torch.from_numpy(np.array(data[key]))
        return parts["in"], parts["out"], parts["w"]

    return read


@pytest.fixture
def manifest(shared):
    """Function that reads the shapes of a published state dict by tensor name."""

    def read(name: str) -> dict[str, tuple[int, ...]]:
        return {k: tuple(v) for k, v in json.loads((shared / "facts" / f"{name}.json").read_text()).items()}

    return read
