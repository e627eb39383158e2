"""π³: estimate of the memory, compared with the measured peak."""

import dataclasses
import weakref

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from stages.core.errors import InputError
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.memory import activations, free, plan, weights
from stages.core.models.pi3.network import Pi3
from stages.core.models.pi3.splat import Pi3Splat

SMALL = Pi3Config(width=128, encoder_depth=1, decoder_depth=4, head_depth=1, camera_width=64,
                  splat_widths=(32, 32, 32), splat_features=32)  # fmt: skip


class PeakMemory(TorchDispatchMode):
    """Tracks current and peak bytes of the tensors allocated within the context, except those of `existing`."""

    def __init__(self, existing):
        super().__init__()
        self.storages, self.current, self.peak = {x.untyped_storage().data_ptr() for x in existing}, 0, 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        for x in tree_leaves(out):
            if isinstance(x, torch.Tensor) and x.untyped_storage().data_ptr() not in self.storages:
                storage = x.untyped_storage()
                self.storages.add(storage.data_ptr())
                self.current += storage.nbytes()
                self.peak = max(self.peak, self.current)
                weakref.finalize(storage, self._release, storage.data_ptr(), storage.nbytes())
        return out

    def _release(self, pointer: int, count: int):
        self.storages.discard(pointer)
        self.current -= count


@torch.no_grad()
@pytest.mark.parametrize("network", [Pi3, Pi3Splat])
@pytest.mark.parametrize(("views", "at_once"), [(4, 4), (12, 1)])
def test_estimate_bounds_the_measured_peak(network, views, at_once):
    model = network(SMALL).eval()
    images = torch.rand(views, 3, 112, 112)
    with PeakMemory([*model.state_dict().values(), images]) as memory:
        model(images, at_once)
    estimate = activations(SMALL, views, (112, 112), at_once, network is Pi3Splat)
    assert 0.95 * memory.peak < estimate < 2 * memory.peak


def test_hundred_photos_fit_12_gb_and_the_batch_shrinks_with_the_budget():
    full = Pi3Config()
    assert plan(full, 100, (448, 448), False, True, 12 * 10**9) >= 1
    assert plan(full, 100, (448, 448), True, True, 40 * 10**9) == 8
    batches = [plan(full, 20, (448, 448), True, True, gigabytes * 10**9) for gigabytes in (40, 6, 4)]
    assert batches == sorted(batches, reverse=True) and batches[0] > batches[-1]
    assert plan(full, 5, (448, 448), False, False, None) == 8


def test_error_names_the_number_of_photos_that_fit():
    with pytest.raises(InputError, match=r"100 photos of 448x448 pixels need .* GB.* (\d+) photos would fit") as caught:
        plan(Pi3Config(), 100, (448, 448), False, True, 2 * 10**9)
    count = int(str(caught.value).split(" photos would fit")[0].split()[-1])
    assert plan(Pi3Config(), count, (448, 448), False, True, 2 * 10**9) >= 1
    with pytest.raises(InputError):
        plan(Pi3Config(), count + 1, (448, 448), False, True, 2 * 10**9)


def test_free_memory_and_size_of_weights():
    assert free("cpu") is None or free("cpu") > 10**8
    model = Pi3(dataclasses.replace(SMALL, decoder_depth=2))
    assert weights(model) == 4 * sum(x.numel() for x in model.state_dict().values())
