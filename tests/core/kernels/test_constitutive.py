"""Constitutive models at a single material point, compared with theory."""

import math

import pytest
import torch
import warp as wp

from stages.core.kernels.interop import device_of, launch, view, with_arrays
from stages.core.kernels.mpm import constitutive as materials
from stages.core.kernels.mpm.constitutive import COROTATED, NEO_HOOKEAN, SAND, SNOW, VON_MISES, material_update
from stages.core.kernels.mpm.transfers import ParticleArrays
from tests.conftest import DEVICES

MU, LAM = 4e4, 6e4


@wp.kernel(enable_backward=False)
def _update(rows: ParticleArrays, dt: float, tau: wp.array[wp.mat33]):
    i = wp.tid()
    out = material_update(int(rows.model[i]), rows.F[i], rows.stiffness[i], rows.plastic[i], rows.state[i], dt)
    rows.F[i] = out.F
    tau[i] = out.tau
    rows.state[i] = out.state


def update_materials(model, F, stiffness, plastic, state, dt: float = 0.0) -> tuple[torch.Tensor, ...]:
    """Elastic F (p, 3, 3), Kirchhoff stress (p, 3, 3) [Pa] and state (p) of particles after `material_update`."""
    F, state, tau = F.clone(), state.clone(), torch.empty_like(F)
    tensors = {"model": model, "F": F, "stiffness": stiffness, "plastic": plastic, "state": state}
    rows = with_arrays(ParticleArrays(), tensors)
    launch(_update, len(F), [rows, dt, view(tau, wp.mat33)], device=device_of(F))
    return F, tau, state


def respond(model: int, F: torch.Tensor, plastic=(0.0, 0.0, 0.0), state: float = 0.0, dt: float = 0.0, *, device: str):
    p = len(F)
    rows = torch.full((p,), model, dtype=torch.int8), F, torch.tensor([[MU, LAM, 0.0]]).repeat(p, 1), \
        torch.tensor([plastic], dtype=torch.float32).repeat(p, 1), torch.full((p,), state)  # fmt: skip
    return tuple(t.cpu() for t in update_materials(*(r.to(device) for r in rows), dt))


def deformed(p: int = 50, size: float = 0.3, seed: int = 0) -> torch.Tensor:
    """Random rotations times random stretches (p, 3, 3)."""
    rng = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(p, 3, 3, generator=rng))[0]
    rotation = rotation * torch.linalg.det(rotation).sign()[:, None, None]
    return rotation @ (torch.eye(3) + size * (torch.rand(p, 3, 3, generator=rng) - 0.5))


def energy(model: int, F: torch.Tensor) -> torch.Tensor:
    """Stored energy per volume at rest [J/m^3]."""
    J = torch.linalg.det(F)
    S = torch.linalg.svdvals(F)
    if model == NEO_HOOKEAN:
        return MU / 2 * (F.square().sum((1, 2)) - 3 - 2 * J.log()) + LAM / 2 * J.log() ** 2
    if model == COROTATED:
        return MU * (S - 1).square().sum(1) + LAM / 2 * (J - 1) ** 2
    return MU * S.log().square().sum(1) + LAM / 2 * S.log().sum(1) ** 2  # Hencky


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("model, plastic", [
    (NEO_HOOKEAN, (0, 0, 0)), (COROTATED, (0, 0, 0)), (VON_MISES, (1e9, 0, 0)), (SNOW, (0.9, 9, 0)),
])  # fmt: skip
def test_stress_is_the_derivative_of_the_stored_energy(model, plastic, device):
    # tau = dW/dF F^T, by autograd in float64, below the yield stress
    F = deformed()
    kept, tau, _ = respond(model, F, plastic, device=device)
    exact = F.double().requires_grad_()
    energy(COROTATED if model == SNOW else model, exact).sum().backward()
    torch.testing.assert_close(tau.double(), exact.grad @ F.double().mT, rtol=0, atol=3e-5 * MU)
    torch.testing.assert_close(kept, F, rtol=0, atol=2e-6)


def test_corotated_equals_its_reference_including_inversion(device):
    F = deformed(size=0.4)
    torch.testing.assert_close(
        respond(COROTATED, F, device=device)[1], materials.corotated_reference(F, MU, LAM), rtol=0, atol=3
    )
    flat = torch.diag(torch.tensor([1.0, 0.8, -0.2]))[None]
    stress = respond(COROTATED, flat, device=device)[1][0]
    # R of an inverted F has no reflection: principal stress 2 mu (s - 1) s + lambda J (J - 1)
    s, J = torch.tensor([1.0, 0.8, -0.2]), -0.16
    torch.testing.assert_close(stress.diag(), 2 * MU * (s - 1) * s + LAM * J * (J - 1), rtol=0, atol=3.0)


def test_small_strains_follow_hookes_law(device):
    # uniaxial strain e: stress (lambda + 2 mu) e along, lambda e across; finite strain changes it by order e^2
    e = 1e-3
    F = torch.diag(torch.tensor([1 + e, 1.0, 1.0]))[None]
    for model, plastic in ((NEO_HOOKEAN, (0, 0, 0)), (COROTATED, (0, 0, 0)), (VON_MISES, (1e9, 0, 0))):
        tau = respond(model, F, plastic, device=device)[1][0]
        expected = torch.tensor([LAM + 2 * MU, LAM, LAM]) * e
        torch.testing.assert_close(tau.diag(), expected, rtol=3 * e, atol=0.05)


def shear(gamma: float) -> torch.Tensor:
    return torch.tensor([[[1.0, gamma, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])


def deviator(tau: torch.Tensor) -> float:
    """Norm of the deviatoric stress."""
    return float((tau - torch.einsum("pii->p", tau)[:, None, None] / 3 * torch.eye(3)).norm())


def test_von_mises_yields_at_the_yield_stress_and_preserves_volume(device):
    strength, F = 1e3, shear(0.2)
    kept, tau, state = respond(VON_MISES, F, (strength, 0, 0), device=device)
    assert deviator(tau) == pytest.approx(math.sqrt(2 / 3) * strength, rel=1e-4)
    assert float(torch.linalg.det(kept)) == pytest.approx(1.0, abs=1e-5)  # plastic flow is isochoric
    # elastic below the yield stress
    small = shear(0.5 * strength / (math.sqrt(3) * MU))
    torch.testing.assert_close(respond(VON_MISES, small, (strength, 0, 0), device=device)[0], small, rtol=0, atol=1e-6)
    # accumulated plastic strain: sqrt(2/3) |de| of the Hencky strain
    e = torch.linalg.svdvals(F).log()[0]
    flow = float(e.norm()) - math.sqrt(2 / 3) * strength / (2 * MU)
    assert float(state) == pytest.approx(math.sqrt(2 / 3) * flow, rel=1e-3)


def test_hardening_and_softening_move_the_yield_stress(device):
    for H in (5e3, -2e3):
        _, tau, state = respond(VON_MISES, shear(0.2), (1e3, H, 0), device=device)
        assert deviator(tau) == pytest.approx(math.sqrt(2 / 3) * (1e3 + H * float(state)), rel=1e-3)
    # softened to the residual strength
    _, tau, _ = respond(VON_MISES, shear(0.2), (1e3, -2e3, 0), state=10.0, device=device)
    assert deviator(tau) == pytest.approx(materials.RESIDUAL_STRENGTH * math.sqrt(2 / 3) * 1e3, rel=1e-3)


def test_viscoplastic_stress_relaxes_at_the_rate_of_perzyna_viscosity(device):
    # Perzyna: the stress above the yield surface decays as exp(-2 mu t / eta)
    strength, eta, F, dt = 1e3, 8e4, shear(0.1), 0.01
    rows = (torch.tensor([VON_MISES], dtype=torch.int8), torch.tensor([[MU, LAM, 0.0]]),
            torch.tensor([[strength, 0.0, eta]]))  # fmt: skip
    model, stiffness, plastic, F, state = (x.to(device) for x in (*rows, F, torch.zeros(1)))
    limit, excess = math.sqrt(2 / 3) * strength, []
    for _ in range(60):
        F, tau, state = update_materials(model, F, stiffness, plastic, state, dt)
        excess.append(deviator(tau.cpu()) - limit)
    rate = math.log(excess[0] / excess[-1]) / (59 * dt)
    # implicit Euler: a factor 1 + 2 mu dt / eta per step instead of the exponential
    assert rate == pytest.approx(math.log(1 + 2 * MU * dt / eta) / dt, rel=0.01)
    assert rate == pytest.approx(2 * MU / eta, rel=0.01)
    at_once = respond(VON_MISES, shear(0.1), (strength, 0, eta), dt=0.0, device=device)
    torch.testing.assert_close(at_once[0], shear(0.1), rtol=0, atol=1e-6)  # dt = 0: no flow


def test_sand_is_projected_to_its_cone_and_separates_without_stress(device):
    angle = math.radians(35)
    slope = materials.sand_slope(35.0)
    F = (torch.diag(torch.tensor([0.98, 0.97, 0.99])) @ shear(0.3)[0])[None]
    _, tau, state = respond(SAND, F, (slope, 0, 0), device=device)
    pressure = -float(torch.einsum("pii->", tau)) / 3
    # in plane strain Coulomb's limit is a shear of sin x pressure, and |dev| is sqrt(2) times the shear
    limit = math.sqrt(2) * math.sin(angle)
    assert deviator(tau) == pytest.approx(limit * pressure, rel=1e-3)
    assert float(state) == 0
    apart = torch.diag(torch.tensor([1.1, 1.0, 1.0]))[None]
    kept, tau, state = respond(SAND, apart, (slope, 0, 0), device=device)
    assert float(tau.abs().max()) < 1e-2 and float(state) == pytest.approx(math.log(1.1), rel=1e-4)
    torch.testing.assert_close(kept, torch.eye(3)[None], rtol=0, atol=1e-6)
    # a volume gain of 10 % is compressed away before stress builds up again
    _, tau, state = respond(
        SAND, torch.diag(torch.tensor([0.95, 1.0, 1.0]))[None], (slope, 0, 0), state=math.log(1.1), device=device
    )
    assert float(tau.abs().max()) < 1e-2 and float(state) == pytest.approx(math.log(1.1 * 0.95), abs=1e-4)


def test_snow_compacts_and_hardens(device):
    compress, stretch, xi = 0.025, 0.0075, 10.0
    compressed = 0.9 * torch.eye(3)[None]
    kept, tau, state = respond(SNOW, compressed, (compress, stretch, xi), device=device)
    torch.testing.assert_close(kept, (1 - compress) * torch.eye(3)[None], rtol=0, atol=1e-5)
    Jp = 0.9**3 / (1 - compress) ** 3
    assert math.exp(float(state)) == pytest.approx(Jp, rel=1e-4)
    hard = min(math.exp(xi * (1 - Jp)), materials.MAX_SNOW_HARDENING)
    J, s = (1 - compress) ** 3, 1 - compress
    assert hard > 1
    assert float(tau[0, 0, 0]) == pytest.approx(hard * (2 * MU * (s - 1) * s + LAM * J * (J - 1)), rel=2e-3)
    kept, _, state = respond(SNOW, 1.1 * torch.eye(3)[None], (compress, stretch, xi), device=device)
    torch.testing.assert_close(kept, (1 + stretch) * torch.eye(3)[None], rtol=0, atol=1e-5)
    assert float(state) > 0  # stretching softens


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.15, 0.3, materials.MAX_LOSS])
def test_maxwell_branches_dissipate_alike_over_a_decade(loss):
    omega = 20.0
    modulus, rate = materials.maxwell_branches(loss, omega)

    def measured(w: float) -> float:
        """tan(delta) of a unit spring in parallel with branches of complex modulus m i w / (k + i w)."""
        E = 1 + sum(m * 1j * w / (k + 1j * w) for m, k in zip(modulus, rate, strict=True))
        return E.imag / E.real

    assert measured(omega) == pytest.approx(loss) and measured(omega / 10) == pytest.approx(loss)
    between = [measured(omega / 10**n) / max(loss, 1e-9) for n in (0.2, 0.4, 0.5, 0.6, 0.8)]
    assert loss == 0 or (min(between) > 0.95 and max(between) < (1.1 if loss <= 0.3 else 1.3))
    assert all(m >= 0 for m in modulus)


def test_maxwell_branches_have_a_largest_loss():
    with pytest.raises(ValueError, match="between 0 and 0.6"):
        materials.maxwell_branches(0.61, 1.0)
