"""Shapes in annotations are checked while tests run: first, and from time to time."""

from importlib.util import find_spec

import pytest
import torch
from jaxtyping import TypeCheckError

from stages.core.geometry.rotations import matrix
from stages.core.models.field.contact_forces import ContactPoints
from tests import EVERY, FIRST

pytestmark = pytest.mark.skipif(find_spec("beartype") is None, reason="beartype is not installed")
UNIT, WRONG = torch.tensor([1.0, 0, 0, 0]), torch.zeros(3)


def test_the_first_calls_and_some_of_the_others_are_checked():
    for _ in range(FIRST):
        with pytest.raises(TypeCheckError):
            matrix(WRONG)
    for _ in range(FIRST + 1, EVERY):
        matrix(UNIT)
    with pytest.raises(TypeCheckError):
        matrix(WRONG)


def test_counts_begin_with_the_test():
    with pytest.raises(TypeCheckError):
        matrix(WRONG)


def test_fields_of_data_classes_are_checked_as_often():
    vectors, scalars, gate = torch.zeros(1, 2, 3, 4, 5, 3), torch.zeros(1, 2, 3, 4, 6), torch.zeros(1, 2, 3, 4)
    right, wrong = torch.zeros(1, 2, 3, 4, dtype=torch.int64), torch.zeros(1, 2, 3, 7, dtype=torch.int64)
    for _ in range(FIRST):
        with pytest.raises(TypeCheckError):
            ContactPoints(vectors, scalars, gate, wrong)
    for _ in range(FIRST + 1, EVERY):
        ContactPoints(vectors, scalars, gate, right)
    with pytest.raises(TypeCheckError):
        ContactPoints(vectors, scalars, gate, wrong)
