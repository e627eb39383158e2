"""The estimate of memory against what is alive at the fullest moment."""

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


class Alive(TorchDispatchMode):
    """Counts the bytes of tensors made inside it that still exist, and their highest number."""

    def __init__(self, known):
        super().__init__()
        self.seen, self.now, self.most = {x.untyped_storage().data_ptr() for x in known}, 0, 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        for x in tree_leaves(out):
            if isinstance(x, torch.Tensor) and x.untyped_storage().data_ptr() not in self.seen:
                storage = x.untyped_storage()
                self.seen.add(storage.data_ptr())
                self.now += storage.nbytes()
                self.most = max(self.most, self.now)
                weakref.finalize(storage, self._gone, storage.data_ptr(), storage.nbytes())
        return out

    def _gone(self, pointer: int, count: int):
        self.seen.discard(pointer)
        self.now -= count


@torch.no_grad()
@pytest.mark.parametrize("network", [Pi3, Pi3Splat])
@pytest.mark.parametrize(("views", "at_once"), [(4, 4), (12, 1)])
def test_the_estimate_is_near_and_not_below_what_is_used(network, views, at_once):
    model = network(SMALL).eval()
    images = torch.rand(views, 3, 112, 112)
    with Alive([*model.state_dict().values(), images]) as alive:
        model(images, at_once)
    said = activations(SMALL, views, (112, 112), at_once, network is Pi3Splat)
    assert 0.95 * alive.most < said < 2 * alive.most


def test_a_hundred_photos_fit_a_common_gpu_and_the_plan_shrinks_with_the_room():
    full = Pi3Config()
    assert plan(full, 100, (448, 448), False, True, 12 * 10**9) >= 1
    assert plan(full, 100, (448, 448), True, True, 40 * 10**9) == 8
    few = [plan(full, 20, (448, 448), True, True, room * 10**9) for room in (40, 6, 4)]
    assert few == sorted(few, reverse=True) and few[0] > few[-1]
    assert plan(full, 5, (448, 448), False, False, None) == 8


def test_what_does_not_fit_says_how_many_would():
    with pytest.raises(InputError, match=r"100 photos of 448x448 need .* GB.* (\d+) photos would fit") as caught:
        plan(Pi3Config(), 100, (448, 448), False, True, 2 * 10**9)
    count = int(str(caught.value).split(" photos would fit")[0].split()[-1])
    assert plan(Pi3Config(), count, (448, 448), False, True, 2 * 10**9) >= 1
    with pytest.raises(InputError):
        plan(Pi3Config(), count + 1, (448, 448), False, True, 2 * 10**9)


def test_memory_of_this_machine_and_of_a_network():
    assert free("cpu") is None or free("cpu") > 10**8
    model = Pi3(dataclasses.replace(SMALL, decoder_depth=2))
    assert weights(model) == 4 * sum(x.numel() for x in model.state_dict().values())
