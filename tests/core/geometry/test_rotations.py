import math

import torch

from stages.core.geometry.rotations import (
    covariance,
    matrix,
    multiply,
    nearest_rotation,
    quaternion,
    rotation_angle,
    rotation_between,
)


def random_quats(n: int) -> torch.Tensor:
    quats = torch.randn(n, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return quats / quats.norm(dim=1, keepdim=True)


def test_quarter_turn_about_z_swaps_x_and_y():
    quarter = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])
    cov = covariance(quarter, torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(cov, torch.diag(torch.tensor([4.0, 1.0, 9.0])))


def test_quaternion_inverts_matrix_also_at_half_turns():
    half_turns = torch.cat([torch.zeros(3, 1), torch.eye(3)], 1).double()
    R = matrix(torch.cat([random_quats(100), half_turns]))
    torch.testing.assert_close(matrix(quaternion(R)), R)


def test_angle_of_a_rotation():
    quats = torch.tensor([[1.0, 0, 0, 0], [0.5**0.5, 0, 0, -(0.5**0.5)], [0, 0, 1.0, 0]], dtype=torch.float64)
    torch.testing.assert_close(rotation_angle(matrix(quats)), torch.tensor([0.0, 90.0, 180.0]).double())


def test_multiply_is_composition():
    a, b = random_quats(20), random_quats(40)[20:]
    torch.testing.assert_close(matrix(multiply(a, b)), matrix(a) @ matrix(b))


def test_rotation_between_directions_also_opposite_ones():
    for a, b in [((0.0, 0, 1), (0.0, 1, 1)), ((0.0, 0, 1), (0.0, 0, -1))]:
        a, b = torch.tensor(a), torch.tensor(b)
        R = rotation_between(a, b)
        torch.testing.assert_close(R @ a, b / b.norm(), atol=1e-6, rtol=0)
        torch.testing.assert_close(torch.det(R), torch.tensor(1.0))


def test_nearest_rotation_removes_a_stretch():
    R = matrix(random_quats(10))
    stretch = torch.diag(torch.tensor([1.5, 1.0, 0.5], dtype=torch.float64))
    torch.testing.assert_close(nearest_rotation(R @ stretch), R)


def test_quaternions_of_any_number_of_batch_dimensions():
    R = matrix(random_quats(24))
    torch.testing.assert_close(quaternion(R.reshape(2, 3, 4, 3, 3)), quaternion(R).reshape(2, 3, 4, 4))


def test_angles_of_rounded_matrices_are_those_of_the_nearest_rotation():
    rounded = (1 + 1e-6) * torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1, -1]))])
    torch.testing.assert_close(rotation_angle(rounded), torch.tensor([0.0, 180.0]))


def test_quaternions_have_no_negative_real_part_and_turns_keep_their_sense():
    quats = random_quats(50)
    found = quaternion(matrix(quats))
    torch.testing.assert_close(found, torch.where(quats[:, :1] < 0, -quats, quats))


def test_opposite_directions_along_any_axis():
    for a in [*torch.eye(3).double(), torch.tensor([1.0, -2, 3]).double(), torch.tensor([-3.0, 1, 0]).double()]:
        R = rotation_between(a, -2 * a)
        torch.testing.assert_close(R @ a, -a, rtol=0, atol=1e-12)
        torch.testing.assert_close(R @ R.mT, torch.eye(3).double())
        torch.testing.assert_close(torch.det(R), torch.tensor(1.0).double())


def test_rotation_between_directions_is_the_smallest():
    a, b = torch.tensor([1.0, 0, 0]).double(), torch.tensor([-1.0, 0.01, 0]).double()
    expected = 180 - math.degrees(math.atan(0.01))
    assert abs(float(rotation_angle(rotation_between(a, b))) - expected) < 1e-6


def test_nearest_rotation_of_a_reflection():
    M = matrix(random_quats(1)) @ torch.diag(torch.tensor([2.0, 1.0, -0.5], dtype=torch.float64))
    R = nearest_rotation(M)
    torch.testing.assert_close(torch.det(R), torch.ones(1).double())
    others = matrix(random_quats(2000))
    assert (R - M).norm() <= (others - M).norm(dim=(1, 2)).min()
