"""The stand-alone Triton kernels of the force field, compared with their references in double precision."""

import pytest
import torch

pytest.importorskip("triton")
if not torch.cuda.is_available():
    pytest.skip("Triton's kernels need an NVIDIA GPU", allow_module_level=True)

from stages.core.kernels.field.nearest import nearest_between_objects, nearest_between_objects_reference
from stages.core.kernels.field.perceptron import perceptron, perceptron_reference
from stages.core.kernels.field.skinny_matmul import skinny_matmul

pytestmark = pytest.mark.gpu


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).cuda()


@pytest.mark.parametrize("b, o, n", [(1, 1, 5), (2, 3, 70), (1, 4, 300)])
def test_nearest_equals_its_reference(b, o, n):
    points = torch.rand(b, o, n, 3, generator=torch.Generator().manual_seed(n)).cuda()
    points[:, -1] += 5  # beyond the radius
    valid = rand(b, o, n) > -1
    valid[-1, 0] = False  # an empty (padding) object
    distance, index = nearest_between_objects(points, valid, 0.2)
    expected, expected_index = nearest_between_objects_reference(points.double(), valid, 0.2)
    torch.testing.assert_close(distance.double(), expected, rtol=1e-6, atol=1e-7)
    finite = expected.isfinite()
    assert torch.equal(index[finite], expected_index[finite])
    assert int(index.min()) >= 0 and int(index.max()) < n


@pytest.mark.parametrize("widths, active, many", [
    ((43, 64, 64, 65), False, 8), ((28, 64, 6), False, 7), ((13, 64, 64), False, 0), ((256, 64, 8), True, 0),
    ((100, 24, 40, 3), True, 0),
])  # fmt: skip
def test_perceptron_equals_its_reference(widths, active, many):
    weights = [rand(b, a) / a**0.5 for a, b in zip(widths, widths[1:], strict=False)]
    biases = [rand(b) for b in widths[1:]]
    vectors = 3 * rand(120, many, 3) if many else None
    x = rand(120, widths[0] - many * (many + 1) // 2)
    known, near = rand(5, widths[0] if active else widths[1]), rand(120) > 0
    near[:32] = False
    found = perceptron(x, weights, biases, vectors, known, near, active)
    exact = [[t.double() for t in layer] for layer in (weights, biases)]
    exact = [x.double(), *exact, vectors if vectors is None else vectors.double()]
    wanted = perceptron_reference(*exact, known.double(), None, active)
    torch.testing.assert_close(found[near].double(), wanted[near], rtol=1e-5, atol=1e-5)
    assert not found[:32].any()  # blocks without rows in `near` are skipped
    bare = perceptron(x, weights, biases, vectors, active=active)
    wanted = perceptron_reference(*exact, active=active)
    torch.testing.assert_close(bare.double(), wanted, rtol=1e-5, atol=1e-5)


def test_skinny_matmul_equals_the_matrix_product():
    A, x = rand(2, 3, 50, 200).half(), rand(2, 3, 200, 9)
    torch.testing.assert_close(skinny_matmul(A, x).double(), A.double() @ x.double(), rtol=1e-5, atol=1e-4)
