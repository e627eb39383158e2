"""Options that list names."""

import pytest

from stages.core.errors import InputError
from stages.lab.names import chosen_names


def test_names_are_listed_with_commas_and_none_means_all():
    assert chosen_names("b, a,", ("a", "b", "c")) == ["b", "a"]
    assert chosen_names(" ", {"a": 1, "b": 2}) == ["a", "b"]


def test_an_unknown_name_is_an_error_with_the_known_ones():
    with pytest.raises(InputError, match="--known goose: choose from duck, ball"):
        chosen_names("duck,goose", ("duck", "ball"), "--known")
