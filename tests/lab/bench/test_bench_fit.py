"""The benchmark of materials from motion: its scenes, its summary, and one complete scene."""

import math
from types import SimpleNamespace

import pytest

from stages.core.errors import InputError
from stages.lab.bench.fit import errors_of, fit_case, measure, summary
from stages.lab.bench.motion_options import FIT_KINDS, FitBenchOptions


def test_scenes_are_drawn_by_seed_and_index():
    for index, kind in enumerate(FIT_KINDS):
        case = fit_case(index, kind, 0)
        same, other = (fit_case(index, kind, seed) for seed in (0, 1))
        assert (case.materials, case.seen, case.other) == (same.materials, same.seen, same.other)
        assert case.materials != other.materials
        assert set(case.materials) == set(range(1, len(case.things) + 1)) and case.seen != case.other


def test_an_unknown_kind_is_refused():
    with pytest.raises(InputError, match="choose from slide"):
        FitBenchOptions(only="fly")


def test_the_summary_counts_what_is_shown():
    def row(error, identifiable):
        return {"quantity": "friction", "error": error, "identifiable": identifiable}

    results = {"a": {"rows": [row(0.05, True), row(-0.3, True)], "default_rmse": 1.0, "fitted_rmse": 0.2},
               "b": {"rows": [row(9.0, False)], "default_rmse": 1.0, "fitted_rmse": 0.8}}  # fmt: skip
    assert summary(results) == [
        "friction: 2 of 3 identifiable, median error 0.175, largest 0.300; 1 within 0.1",
        "another motion: RMSE over that by default 0.50 (median), 1 of 2 halved",
    ]


def test_stiffness_and_density_are_compared_relative_to_the_first_density():
    case, names = fit_case(0, "soft", 3), ("density", "E", "friction")
    true = case.materials[1]
    doubled = {
        "density": math.log10(2 * true.density),
        "E": math.log10(2 * true.E),
        "friction": true.friction,
    }  # doubling both density and E does not change the motion
    fit = SimpleNamespace(
        problem=SimpleNamespace(parameters=[SimpleNamespace(name=name, object_id=1) for name in names],
                                materials={1: SimpleNamespace(density=2 * true.density)}),
        is_identifiable=lambda k: True, value=lambda k: doubled[names[k]], half_width=lambda k: 0.1,
    )  # fmt: skip
    assert [row["error"] for row in errors_of(fit, case)] == pytest.approx([0, 0, 0], abs=1e-9)


@pytest.mark.slow
def test_friction_of_two_blocks_that_slide(device):
    row = measure(fit_case(0, "slide", 0), FitBenchOptions(workers=1, evaluations=300))
    friction = [r for r in row["rows"] if r["quantity"] == "friction"]
    assert [r["identifiable"] for r in friction] == [True, True]
    assert max(abs(r["error"]) for r in friction) < 0.1 and row["fitted_rmse"] < row["default_rmse"] / 2
