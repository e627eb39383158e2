"""Krippendorff's alpha, compared with the worked examples of its author and of Wikipedia."""

import numpy as np
import pytest

from stages.lab.questionnaire.agreement import coincidences, krippendorff_alpha

FOUR_OBSERVERS = """
1 2 3 3 2 1 4 1 2 . . .
1 2 3 3 2 2 4 1 2 5 . 3
. 3 3 3 2 3 4 2 2 5 1 .
1 2 3 3 2 4 4 1 2 5 1 .
"""  # Krippendorff 2011, section C
TWO_VALUES = """
1 2 1 1 1 1 1 1 2 1
2 2 2 1 1 2 1 1 1 1
"""  # section A: binary data, where all metrics agree
THREE_CODERS = """
. . . . . 3 4 1 2 1 1 3 3 . 3
1 . 2 1 3 3 4 3 . . . . . . .
. . 2 1 3 4 4 . 2 1 1 3 3 . 4
"""  # https://en.wikipedia.org/wiki/Krippendorff's_alpha#A_computational_example


def alpha(table: str, ordinal: bool) -> float:
    ratings = np.array([[0 if x == "." else int(x) for x in row.split()] for row in table.strip().splitlines()])
    return float(krippendorff_alpha(coincidences(ratings, 5).sum(0), ordinal))


@pytest.mark.parametrize(("table", "ordinal", "published"), [
    (FOUR_OBSERVERS, True, 0.815), (FOUR_OBSERVERS, False, 0.849), (TWO_VALUES, True, 0.095),
    (TWO_VALUES, False, 0.095), (THREE_CODERS, False, 0.811),
])  # fmt: skip
def test_published_examples(table, ordinal, published):
    assert alpha(table, ordinal) == pytest.approx(published, abs=0.0005)


@pytest.mark.parametrize("ordinal", [True, False])
def test_agreement_disagreement_and_nothing_to_compare(ordinal):
    assert alpha("1 2 5 3\n1 2 5 3", ordinal) == pytest.approx(1)
    assert alpha("1 5 1 5\n5 1 5 1", ordinal) < 0
    assert np.isnan(alpha("3 3 3\n3 3 3", ordinal))
    assert np.isnan(alpha("1 . 2\n. 3 .", ordinal))


def test_random_ratings_agree_by_chance():
    ratings = np.random.default_rng(0).integers(1, 6, (20, 400))
    # the standard error for 400 units of 20 ratings is about sqrt(2 / (400 * 20 * 19)) = 0.004
    assert abs(krippendorff_alpha(coincidences(ratings, 5).sum(0), True)) < 0.015
