"""External forces: conversion of force prompts, active times, wrenches and accelerations."""

import pytest
import torch

from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass
from stages.core.physics.forces import Force, ForcePrompts
from tests.core.models.dynamics_fixtures import external_force, overlapping_objects


def test_conversion_of_force_prompts():
    initial = overlapping_objects(1, 2, 10)
    position = tuple((initial.points[0, 1, 4] + 1e-4).tolist())
    prompts = ForcePrompts(
        (Force(7, (1.0, 2.0, 3.0), start=0.1), Force(3, torque=(0.0, 0.0, 1.0), end=0.5, at=position)), frozenset({7})
    )
    external = ExternalForces.from_prompts(initial, prompts, [7, 3])
    assert external.object.tolist() == [[0, 1]] and external.point.tolist() == [[-1, 4]]
    assert external.pinned.tolist() == [[True, False]]
    assert external.end[0, 0] == torch.inf


def test_active_fraction_over_a_frame_and_at_an_instant():
    initial = overlapping_objects(1)
    external = external_force(initial, 0, (1.0, 0, 0), start=0.1, end=0.3)
    fractions = [float(external.active_fraction(t, 0.04)) for t in (0.0, 0.08, 0.2, 0.29)]
    assert fractions == pytest.approx([0, 0.5, 1, 0.25])
    assert [float(external.active_fraction(t)) for t in (0.1, 0.2, 0.3)] == [0, 1, 0]


def test_forces_on_the_same_object_are_summed_and_padding_is_ignored():
    initial = overlapping_objects(1)
    rows = torch.tensor([[1, 1, 0]])
    force = torch.tensor([[[1.0, 0, 0], [0, 2, 0], [0, 0, 0]]]).double()
    infinity = torch.full((1, 3), torch.inf).double()
    no_point, unpinned = torch.full((1, 3), -1), ExternalForces.none(initial).pinned
    external = ExternalForces(rows, force, torch.zeros_like(force), -infinity, infinity, no_point, unpinned)
    total, torque = external.wrench(initial.points, centre_of_mass(initial, initial.points), 0.0)
    assert total[0].tolist() == [[0, 0, 0], [1, 2, 0], [0, 0, 0]] and (torque == 0).all()


def test_force_at_a_point_causes_torque():
    initial = overlapping_objects(1)
    com = centre_of_mass(initial, initial.points)
    _, torque = external_force(initial, 1, (0.0, 0.0, 2.0), point=3).wrench(initial.points, com, 0.0)
    arm = initial.points[0, 1, 3] - com[0, 1]
    torch.testing.assert_close(torque[0, 1], torch.stack([2 * arm[1], -2 * arm[0], torch.zeros_like(arm[0])]))


def test_point_accelerations_sum_to_force_and_torque():
    initial = overlapping_objects()
    external = external_force(initial, 2, (1.0, -2.0, 0.5), (0.3, 0.1, -0.2))
    a = external.acceleration(initial, initial.points, 0.0)
    m = (initial.mass[..., None] * initial.mass_fraction)[..., None]
    arm = initial.points - centre_of_mass(initial, initial.points)[:, :, None]
    force, torque = (m * a).sum(2), (m * torch.linalg.cross(arm, a)).sum(2)
    torch.testing.assert_close(force[:, 2], external.force[:, 0])
    torch.testing.assert_close(torque[:, 2], external.torque[:, 0], rtol=0.02, atol=2e-3)  # inertia is regularised
    assert (a[:, :2] == 0).all()


def test_torque_on_a_single_point_is_finite():
    # a single keypoint has zero inertia
    a = external_force(InitialConditions.of(torch.zeros(1, 1, 1, 3)), 0, torque=(1.0, 0, 0))
    assert a.acceleration(InitialConditions.of(torch.zeros(1, 1, 1, 3)), torch.zeros(1, 1, 1, 3), 0.0).isfinite().all()
