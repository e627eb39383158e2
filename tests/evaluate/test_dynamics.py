"""Metrics of predicted motion."""

import numpy as np
import pytest
import torch

from stages.evaluate.dynamics import (
    all_metrics,
    correlation,
    error_over_time,
    fpe,
    mse,
    pce,
    pooled_correlation,
    rmse,
)


def motion(t=20, o=2, p=5, seed=0):
    """Random walks, so that every coordinate changes."""
    rng = torch.Generator().manual_seed(seed)
    return torch.randn(t, o, p, 3, generator=rng, dtype=torch.float64).cumsum(0)


def test_constant_offset():
    # positions have an offset d, displacements are correct, and the correlation over time is invariant to an offset
    truth, d = motion(), 0.25
    metrics = {k: float(v) for k, v in all_metrics(truth + d, truth).items()}
    expected = {"MSE": d * d, "RMSE": d, "PCE": 0.0, "FPE": d * 3**0.5, "R": 1.0, "R_pooled": 1.0}
    assert metrics == pytest.approx(expected, abs=1e-12)


def test_reversed_motion_has_correlation_minus_one():
    truth = motion()
    assert float(correlation(-truth, truth)) == pytest.approx(-1, abs=1e-12)
    assert float(pooled_correlation(-truth, truth)) == pytest.approx(-1, abs=1e-12)


def test_two_frames_by_hand():
    # one point that moves by 3 along x and 4 along y, and is predicted to be at rest
    truth = torch.zeros(2, 1, 1, 3)
    truth[1, 0, 0] = torch.tensor([3.0, 4.0, 0.0])
    still = torch.zeros_like(truth)
    assert float(mse(still, truth)) == pytest.approx(25 / 6)  # 6 coordinates: 2 frames with 3 each
    assert float(rmse(still, truth)) == pytest.approx((25 / 6) ** 0.5)
    assert float(pce(still, truth)) == pytest.approx(5)
    assert float(fpe(still, truth)) == pytest.approx(5)
    assert float(correlation(still, truth)) == 0  # it is zero for a moving coordinate predicted to be at rest
    assert error_over_time(still, truth).squeeze().tolist() == [0, 5]


def test_correlation_is_the_mean_of_numpy_corrcoef_over_moving_coordinates():
    truth, predicted = motion(), motion(seed=1)
    truth[:, 1, :, 2] = 1e-5 * truth[:, 1, :, 2]  # at rest and therefore excluded
    series = [
        (predicted[:, o, p, i], truth[:, o, p, i]) for o in range(2) for p in range(5) for i in range(3)
        if not (o == 1 and i == 2)
    ]  # fmt: skip
    expected = np.mean([np.corrcoef(a.numpy(), b.numpy())[0, 1] for a, b in series])
    assert float(correlation(predicted, truth)) == pytest.approx(expected, abs=1e-12)


def test_pooled_correlation_is_numpy_corrcoef_of_all_displacements():
    truth, predicted = motion(), motion(seed=1)
    a, b = ((x - x[:1]).flatten().numpy() for x in (predicted, truth))
    assert float(pooled_correlation(predicted, truth)) == pytest.approx(np.corrcoef(a, b)[0, 1], abs=1e-12)


def test_correlation_without_motion_is_undefined():
    truth = torch.ones(5, 1, 3, 3)
    assert correlation(truth, truth).isnan() and pooled_correlation(truth, truth).isnan()


def test_rmse_of_a_scene_is_not_the_mean_over_objects():
    truth = motion()
    wrong = truth.clone()
    wrong[:, 0] += 1.0
    assert float(rmse(wrong, truth)) == pytest.approx(0.5**0.5)


def test_masked_points_have_no_effect():
    truth, predicted = motion(), motion(seed=1)
    mask = torch.ones(2, 5, dtype=torch.bool)
    mask[1, 3:] = False
    padded = predicted.clone()
    padded[:, 1, 3:] = 1e6
    for name, value in all_metrics(padded, truth, mask).items():
        again = predicted.clone()
        again[:, 1, 3:] = -7.0
        torch.testing.assert_close(value, all_metrics(again, truth, mask)[name])
    alone = {k: float(v) for k, v in all_metrics(predicted[:, 1:, :3], truth[:, 1:, :3]).items()}
    only = mask.clone()
    only[0] = False
    assert {k: float(v) for k, v in all_metrics(padded, truth, only).items()} == pytest.approx(alone)
    torch.testing.assert_close(error_over_time(padded, truth, mask)[:, 1],
                               error_over_time(predicted[:, 1:, :3], truth[:, 1:, :3])[:, 0])  # fmt: skip


def test_batch_dimension_gives_one_value_per_scene():
    truth = torch.stack([motion(seed=s) for s in (0, 1)])
    predicted = torch.stack([motion(seed=s) for s in (2, 3)])
    for name, value in all_metrics(predicted, truth).items():
        assert value.shape == (2,)
        for b in range(2):
            torch.testing.assert_close(value[b], all_metrics(predicted[b], truth[b])[name])


def test_frames_in_which_an_object_is_lost_do_not_count():
    truth = torch.randn(6, 2, 5, 3, generator=torch.Generator().manual_seed(0)).double().cumsum(0)
    predicted, seen = truth + 0.1, torch.ones(6, 2, dtype=torch.bool)
    seen[2:4, 0] = seen[5, 1] = False
    wrong = torch.where(seen[:, :, None, None], predicted, 100.0)
    for name, value in all_metrics(wrong, truth, seen=seen).items():
        torch.testing.assert_close(value, all_metrics(predicted, truth, seen=seen)[name])
    every = all_metrics(predicted, truth, seen=torch.ones(6, 2, dtype=torch.bool))
    for name, value in all_metrics(predicted, truth).items():
        torch.testing.assert_close(value, every[name])
    assert float(fpe(wrong, truth, seen=seen)) == pytest.approx(0.1 * 3**0.5)
