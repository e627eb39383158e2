"""Selection of backends by name, and the device of --device."""

import pytest
import torch

from stages.core.backends import Backend, choose, pick_device
from stages.core.errors import InputError


def test_an_unknown_name_is_reported_with_its_option():
    table = {"add": "operator:add", "mul": Backend("operator:mul", "the product")}
    assert choose(table, "--backend", "mul")(2, 3) == 6 and choose(table, "--backend", "add")(2, 3) == 5
    with pytest.raises(InputError, match="--backend magic: choose from add, mul"):
        choose(table, "--backend", "magic")


@pytest.mark.parametrize("name", ["gpu", "cpu:0", "cuda:", "cuda:x", "cuda:-1", "auto:0"])
def test_other_names_are_refused(name, device):
    with pytest.raises(InputError, match=f"--device {name}: choose from"):
        pick_device(name)


def test_numbered_gpus(device):
    assert pick_device("auto") == device
    if device == "cpu":
        with pytest.raises(InputError, match="--device cuda:0: PyTorch sees no NVIDIA GPU"):
            pick_device("cuda:0")
        return
    count = torch.cuda.device_count()
    for number in (count - 1, 0):
        assert pick_device(f"cuda:{number}") == "cuda" and torch.zeros(1, device="cuda").device.index == number
    with pytest.raises(InputError, match=f"PyTorch sees {count} GPUs here"):
        pick_device(f"cuda:{count}")
