"""One kernel for the free motion of rigid bodies against the tensor form of the same, in double precision."""

import torch

from stages.core.kernels.field import rigid_motion as kernels
from stages.core.models.field import rigid_body as rigid


def bodies(device: str) -> list[torch.Tensor]:
    """Places, orientations, velocities, angular momenta and inverse inertias; one does not spin."""
    rng = torch.Generator().manual_seed(0)
    com, velocity, momentum, quat = (torch.randn(2, 5, k, generator=rng) for k in (3, 3, 3, 4))
    root = torch.randn(2, 5, 3, 3, generator=rng)
    momentum[0, 0] = 0
    return [x.to(device) for x in (com, quat / quat.norm(dim=-1, keepdim=True), velocity, momentum, root @ root.mT)]


@torch.no_grad()
def test_drift_and_pose_equal_their_tensor_form(device):
    com, quat, velocity, momentum, inverse = given = bodies(device)
    found = [*kernels.drift(*given, 0.1), *kernels.pose(quat, momentum, inverse)]
    exact = [x.double() for x in given]  # which the kernels do not take
    wanted = [*rigid.drift(*exact, 0.1), *rigid.pose(exact[1], exact[3], exact[4])]
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=2e-6)  # turns of up to 3 rad in float32
    assert torch.equal(found[1][0, 0], quat[0, 0] / quat[0, 0].norm())


def test_the_tensor_form_is_taken_where_gradients_are_wanted():
    given = bodies("cpu")
    given[3].requires_grad_()
    rigid.drift(*given, 0.1)[1].sum().backward()
    assert given[3].grad.abs().max() > 0
