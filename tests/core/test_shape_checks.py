"""Shapes in annotations are checked in the first calls of each test and in some of the later ones."""

from collections.abc import Iterator
from importlib.util import find_spec

import pytest
import torch
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.models.field.contact_forces import ContactPoints
from tests import EVERY, FIRST, check_some

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


def test_letters_are_the_same_length_in_all_arguments_and_the_result():
    @check_some(typechecker=None)
    def first_of(a: "Float[Tensor, 'n 3']", b: "Float[Tensor, 'n']", count: int) -> "Float[Tensor, 'n']":
        return b[:count]

    table, row = torch.zeros(4, 3), torch.zeros(4)
    assert len(first_of(table, row, 4)) == 4
    for b, count in ((row[:3], 3), (row, 3)):
        with pytest.raises(TypeCheckError):
            first_of(table, b, count)


def test_what_a_function_calls_has_letters_of_its_own():
    @check_some(typechecker=None)
    def doubled(x: Float[Tensor, "n"]) -> Float[Tensor, "m"]:
        return torch.cat([x, x])

    @check_some(typechecker=None)
    def four_times(x: Float[Tensor, "n"]) -> Float[Tensor, "m"]:
        return doubled(doubled(x))

    assert len(four_times(torch.zeros(3))) == 12


def test_annotations_that_are_not_known_do_not_hinder_the_others():
    @check_some(typechecker=None)
    def known(x: "Float[Tensor, '3']", other: "Absent" = None) -> "Absent":  # noqa: F821
        return x

    assert len(known(WRONG)) == 3
    with pytest.raises(TypeCheckError):
        known(UNIT)


def test_arguments_of_generators_are_checked():
    from beartype import beartype

    @check_some(typechecker=beartype)
    def each(x: Float[Tensor, "3"]) -> Iterator[Float[Tensor, ""]]:
        yield from x

    assert len(list(each(WRONG))) == 3
    with pytest.raises(TypeCheckError):
        each(UNIT)
