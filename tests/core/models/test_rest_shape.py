"""Rest shapes computed by GPU kernels, compared with PyTorch in double precision."""

import copy

import pytest
import torch

pytest.importorskip("triton")
if not torch.cuda.is_available():
    pytest.skip("Triton's kernels need an NVIDIA GPU", allow_module_level=True)

from stages.core.models.field.force_field import ForceField
from tests.core.models.dynamics_fixtures import add_padding, overlapping_objects

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("initial", [
    overlapping_objects(2, 3, 200), add_padding(overlapping_objects(2, 3, 70), 1, 3),
    overlapping_objects(1, 1, 3), overlapping_objects(1, 2, 2048)
], ids=["overlapping", "padded", "few", "many"])  # fmt: skip
@torch.no_grad()
def test_prepared_scene_equals_double_precision(initial):
    torch.manual_seed(0)
    model = ForceField().eval()
    exact = copy.deepcopy(model).double().cuda()
    single = initial.to(torch.float32).to("cuda")  # both models get the same points
    expected = exact.prepare(single.to(torch.float64))
    scene = model.cuda().prepare(single)
    actual, reference = scene.shape, expected.shape
    assert actual.blur.dtype == torch.float16
    # half a unit in the last place of 11 bits, plus the error of single precision
    torch.testing.assert_close(actual.blur.double(), reference.blur, rtol=2**-11 + 5e-5, atol=2**-25 + 1e-9)
    for name in ("arm", "normal", "spacing", "size", "inverse", "principal"):
        torch.testing.assert_close(getattr(actual, name).double(), getattr(reference, name), rtol=1e-5, atol=5e-5)
    for name in ("embedding", "stiffness", "damping"):
        torch.testing.assert_close(getattr(scene, name).double(), getattr(expected, name), rtol=1e-4, atol=1e-4)
    momentum = model.initial_state(scene).momentum.double()
    torch.testing.assert_close(momentum, exact.initial_state(expected).momentum, rtol=1e-5, atol=1e-7)
    row_sums = actual.blur.float().sum(-1)[single.valid[:, :, None].expand(actual.blur.shape[:-1])]
    assert (row_sums - 1).abs().max() < 2**-11 * 2 and not actual.blur.isnan().any()
