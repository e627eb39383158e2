"""Solidity of bodies, and its effect on the inputs and rollouts of the force field."""

import pytest
import torch

from stages.core.geometry.rotations import matrix
from stages.core.models.checkpoints import SHIPPED, find, load
from stages.core.models.field.force_field import MAX_TRAINED_SOLID_STIFFNESS, MAX_TRAINED_STIFFNESS, ForceField
from stages.core.models.field.solidity import REFERENCE_THICKNESS, box_sides, solidity
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.integrate import Integration


def slab(x=0.5, y=0.3, z=0.01):
    axes = [torch.linspace(-side, side, n) for side, n in ((x, 20), (y, 12), (z, 30))]
    points = torch.cartesian_prod(*axes)
    return points @ matrix(torch.tensor([0.9, 0.3, -0.2, 0.1]) / 0.95**0.5).mT


def test_box_sides_of_a_slab():
    assert box_sides(slab()).tolist() == pytest.approx([0.02, 0.6, 1.0], rel=0.1)


def test_solidity_grows_with_the_cube_of_the_thickness():
    a, b, c = box_sides(slab()).tolist()
    reference_volume = REFERENCE_THICKNESS * 2 * (a * b + b * c + c * a)
    assert solidity(slab(), reference_volume) == pytest.approx(1) and solidity(slab(), reference_volume / 3) == 1
    assert solidity(slab(), 2 * reference_volume) == pytest.approx(8)


def encoded(E, solidity):
    """Stiffness passed to the network [Pa], compliance scale, and mass / size [kg/m] of an encoded body."""
    points = 0.3 * torch.randn(1, 1, 60, 3, generator=torch.Generator().manual_seed(0))
    initial = InitialConditions.of(points, E=torch.tensor(E), solidity=torch.tensor(solidity))
    model, calls = ForceField(16), []
    model._embed_objects = lambda shape, E: calls.append(float(E)) or torch.zeros(1, 1, 16)
    shape = model.precompute(initial)
    scene = model.encode(shape)
    return calls[0], float(scene.compliance_scale), 1 / float(shape.size)


def test_solid_body_is_encoded_as_a_stiffer_one_up_to_the_trained_range():
    """Encoded stiffness over compliance scale is always the effective stiffness."""
    assert encoded(1e3, 1.0)[:2] == (1e3, 1.0)
    assert encoded(1e3, 8.0)[:2] == pytest.approx((8e3, 1.0))
    encoded_E, compliance_scale, unit = encoded(2e3, 1e6)
    assert encoded_E == pytest.approx(
        MAX_TRAINED_SOLID_STIFFNESS * unit, rel=1e-4
    ) and encoded_E / compliance_scale == pytest.approx(2e9, rel=1e-4)
    encoded_E, compliance_scale, unit = encoded(
        5 * MAX_TRAINED_SOLID_STIFFNESS * unit, 2.0
    )  # never softer than the material
    assert encoded_E == pytest.approx(
        5 * MAX_TRAINED_SOLID_STIFFNESS * unit, rel=1e-4
    ) and compliance_scale == pytest.approx(0.5, rel=1e-4)
    encoded_E, compliance_scale, unit = encoded(7e10, 1.0)
    assert encoded_E == pytest.approx(
        MAX_TRAINED_STIFFNESS * unit, rel=1e-4
    ) and encoded_E / compliance_scale == pytest.approx(7e10, rel=1e-4)


def dropped(solidity, method="step", E=3e4, frames=40):
    """Height of a soft ball relative to its initial height, in each frame after a drop from 0.3 m."""
    p = torch.nn.functional.normalize(torch.randn(1, 1, 200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    points = 0.25 * p + torch.tensor([0.0, 0.0, 0.3 + 0.25 - 0.94])
    initial = InitialConditions.of(points, E=torch.tensor(E), mass=torch.tensor(8.0), solidity=torch.tensor(solidity))
    with torch.inference_mode():
        z = load(find("ngff", SHIPPED))[0].rollout(initial, frames, integration=Integration(method))[0, :, 0, :, 2]
    height = z.amax(1) - z.amin(1)
    return height / height[0]


def test_solid_ball_deforms_on_landing_and_recovers():
    """The reference is MPM with 0.0133 m particle spacing: 14 % maximum compression, 0 % afterwards."""
    solid, hollow = dropped(38.0), dropped(1.0)
    assert 0.75 < solid.min() < 0.95 and solid[30:35].min() > 0.98
    assert hollow[30:35].max() < 0.9


def test_springs_of_very_stiff_solid_bodies_are_stable_with_explicit_steps():
    height = dropped(1e3, "rk4", E=1e10, frames=25)  # it lands in the 13th frame
    assert height.isfinite().all() and (height - 1).abs().max() < 0.1
