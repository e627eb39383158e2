"""What is known of objects at rest, by the kernels of a GPU, against PyTorch in double precision."""

import copy

import pytest
import torch

pytest.importorskip("triton")
if not torch.cuda.is_available():
    pytest.skip("Triton's kernels need an NVIDIA GPU", allow_module_level=True)

from stages.core.models.field.force_field import ForceField  # noqa: E402
from tests.core.models.worlds import crowd, padded  # noqa: E402

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("initial", [
    crowd(2, 3, 200), padded(crowd(2, 3, 70), 1, 3), crowd(1, 1, 3), crowd(1, 2, 2048)
], ids=["crowd", "padded", "few", "many"])  # fmt: skip
@torch.no_grad()
def test_a_scene_is_prepared_as_in_double_precision(initial):
    torch.manual_seed(0)
    model = ForceField().eval()
    exact = copy.deepcopy(model).double().cuda()
    there = initial.to(torch.float32).to("cuda")  # both see the same points
    wanted = exact.prepare(there.to(torch.float64))
    scene = model.cuda().prepare(there)
    found, true = scene.shape, wanted.shape
    assert found.blur.dtype == torch.float16
    # half a unit in the last of 11 bits, and single precision before
    torch.testing.assert_close(found.blur.double(), true.blur, rtol=2**-11 + 5e-5, atol=2**-25 + 1e-9)
    for name in ("arm", "normal", "spacing", "size", "inverse", "principal"):
        torch.testing.assert_close(getattr(found, name).double(), getattr(true, name), rtol=1e-5, atol=5e-5)
    for name in ("code", "stiffness", "damping"):
        torch.testing.assert_close(getattr(scene, name).double(), getattr(wanted, name), rtol=1e-4, atol=1e-4)
    spun = model.initial_state(scene).momentum.double()
    torch.testing.assert_close(spun, exact.initial_state(wanted).momentum, rtol=1e-5, atol=1e-7)
    whole = found.blur.float().sum(-1)[there.valid[:, :, None].expand(found.blur.shape[:-1])]
    assert (whole - 1).abs().max() < 2**-11 * 2 and not found.blur.isnan().any()
