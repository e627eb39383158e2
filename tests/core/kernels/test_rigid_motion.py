"""The rigid-motion kernels, compared with their tensor form in double precision."""

import torch

from stages.core.kernels.field import rigid_motion as kernels
from stages.core.models.field import rigid_body as rigid


def bodies(device: str) -> list[torch.Tensor]:
    """Centres of mass, quaternions, velocities, angular momenta (one of them 0) and inverse inertias."""
    rng = torch.Generator().manual_seed(0)
    com, velocity, momentum, quat = (torch.randn(2, 5, k, generator=rng) for k in (3, 3, 3, 4))
    root = torch.randn(2, 5, 3, 3, generator=rng)
    momentum[0, 0] = 0
    return [x.to(device) for x in (com, quat / quat.norm(dim=-1, keepdim=True), velocity, momentum, root @ root.mT)]


@torch.no_grad()
def test_drift_and_pose_equal_their_tensor_form(device):
    com, quat, velocity, momentum, inverse = given = bodies(device)
    found = [*kernels.drift(*given, 0.1), *kernels.pose(quat, momentum, inverse)]
    exact = [x.double() for x in given]  # not supported by the kernels, so the tensor form is used
    wanted = [*rigid.drift(*exact, 0.1), *rigid.pose(exact[1], exact[3], exact[4])]
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=2e-6)  # rotations of up to 3 rad in float32
    alone = quat[0, 0] / quat[0, 0].norm()  # without angular momentum the quaternion is only normalised
    if device == "cpu":
        assert torch.equal(found[1][0, 0], alone)
    else:  # the norm is rounded differently on this device
        torch.testing.assert_close(found[1][0, 0], alone, rtol=0, atol=2e-7)


@torch.no_grad()
def test_kernels_are_opaque_to_the_compiler(device):
    given = bodies(device)
    compiled = torch.compile(lambda *x: kernels.drift(*x, 0.1), fullgraph=True, dynamic=False, backend="aot_eager")
    assert all(map(torch.equal, compiled(*given), kernels.drift(*given, 0.1)))


def test_tensor_form_is_used_when_gradients_are_required():
    given = bodies("cpu")
    given[3].requires_grad_()
    rigid.drift(*given, 0.1)[1].sum().backward()
    assert given[3].grad.abs().max() > 0
