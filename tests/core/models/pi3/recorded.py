"""Values recorded from the published code, and the names and shapes of its weights."""

import json

import numpy as np
import pytest
import torch

CLOSE = {"rtol": 1e-4, "atol": 1e-5}  # as the recordings state


@pytest.fixture
def recorded(shared):
    """A function that reads one recording: inputs, outputs, and the weights as a state dict."""

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
    def read(name: str) -> dict[str, tuple[int, ...]]:
        return {k: tuple(v) for k, v in json.loads((shared / "facts" / f"{name}.json").read_text()).items()}

    return read
