"""Constitutive models: Kirchhoff stress and plastic flow (return mapping) of particles.

`material_update` takes a trial deformation gradient and returns its elastic part after plastic flow, the Kirchhoff
stress and the new state variable. The transfers add Kelvin-Voigt damping, eta (dv/dx + transpose), for all models, and
two Maxwell branches if any particle has them: springs with `branch_modulus` times the elastic moduli, each in series
with a damper that relaxes it at `branch_rate` [1/s]. `branch_strain` is b - I, with the left Cauchy-Green tensor b of
each spring; the stress is linear in it (Reese and Govindjee 1998, "A theory of finite viscoelasticity and numerical
aspects", near equilibrium). The loss factor of the two branches is about the same at all frequencies between their
rates (maxwell_branches), and the stable substep depends on their stiffness, not on their viscosity.

| model       | elastic law                   | plastic (3 numbers)                                | state       |
| NEO_HOOKEAN | mu (F F^T - I) + lambda log J | -                                                  | -           |
| COROTATED   | fixed corotated               | -                                                  | -           |
| VON_MISES   | Hencky                        | yield stress, hardening (softening < 0), viscosity | strain      |
| SAND        | Hencky                        | slope of the Drucker-Prager cone, -, -             | volume gain |
| SNOW        | fixed corotated, hardened     | critical compression, critical stretch, hardening  | log Jp      |

Sources: Bonet and Wood 2008, "Nonlinear Continuum Mechanics for Finite Element Analysis", eq. 6.29 (neo-Hookean);
Stomakhin et al. 2012, "Energetically consistent invertible elasticity" (fixed corotated); Simo and Hughes 1998,
"Computational Inelasticity", box 3.1 (von Mises with Perzyna viscosity, in Hencky strain); Klar et al. 2016,
"Drucker-Prager elastoplasticity for sand animation", with the volume correction of Tampubolon et al. 2017;
Stomakhin et al. 2013, "A material point method for snow simulation".
"""

from __future__ import annotations

import math

import numpy as np
import torch
import warp as wp
from torch import Tensor

NEO_HOOKEAN, COROTATED, VON_MISES, SAND, SNOW = range(5)
MIN_VOLUME_RATIO = 0.05  # smaller volume ratios (and principal stretches) are clamped in the stress
MAX_SNOW_HARDENING = 4.0  # limit of snow's stiffness factor, so that the CFL condition holds with twice the wave speed
MAX_STIFFENING = (1.0, 1.0, 1.0, 1.0, MAX_SNOW_HARDENING)  # largest factor on the stiffness, by model
MAX_LOSS = 0.6  # largest loss factor of two Maxwell branches; at .7 they are eight times as stiff as the elastic spring
BRANCH_RATIO = 10.0  # ratio of the relaxation times of the two branches
RESIDUAL_STRENGTH = 0.1  # minimum yield stress after softening, as a fraction of the initial yield stress


@wp.struct
class MaterialUpdate:
    """Result of a material update.

    F is the elastic deformation gradient, tau the Kirchhoff stress [Pa], state as in the module's table.
    """

    F: wp.mat33
    tau: wp.mat33
    state: float


@wp.func
def neo_hookean(F: wp.mat33, stiffness: wp.vec3) -> wp.mat33:
    """Kirchhoff stress mu (F F^T - I) + lambda log(J) I; `stiffness` is mu, lambda, eta."""
    J = wp.max(wp.determinant(F), MIN_VOLUME_RATIO)
    one = wp.identity(n=3, dtype=float)
    return stiffness[0] * (F * wp.transpose(F) - one) + stiffness[1] * wp.log(J) * one


@wp.func
def branch_update(e: wp.mat33, C: wp.mat33, rate: float, dt: float) -> wp.mat33:
    """Advance the strain e = b - I of a Maxwell branch by `dt` [s] at the velocity gradient `C` [1/s].

    Solves e' = C b + b C^T - rate e, with an implicit step for the relaxation, which is stable for any rate.
    """
    half = C + C * e
    return (e + dt * (half + wp.transpose(half))) / (1.0 + dt * rate)


@wp.func
def branch_stress(e: wp.mat33, stiffness: wp.vec3) -> wp.mat33:
    """Kirchhoff stress of a strain e = b - I: `neo_hookean` to first order in e."""
    return stiffness[0] * e + 0.5 * stiffness[1] * wp.trace(e) * wp.identity(n=3, dtype=float)


@wp.func
def _cofactors(A: wp.mat33) -> wp.mat33:
    """Cofactor matrix: det(A) times the inverse transpose of A."""
    a = wp.vec3(A[0, 0], A[0, 1], A[0, 2])
    b = wp.vec3(A[1, 0], A[1, 1], A[1, 2])
    c = wp.vec3(A[2, 0], A[2, 1], A[2, 2])
    return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))


@wp.func
def _corotated(F: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """2 mu (F - R) F^T + lambda J (J - 1) I, for J > MIN_VOLUME_RATIO; R by Newton's iteration (Higham 1986)."""
    J = wp.determinant(F)
    R = F
    for _n in range(20):
        C = _cofactors(R)
        D = wp.determinant(R)
        N = 0.5 * (R + C / D)
        change = wp.ddot(N - R, N - R)
        R = N
        if change < 1e-10:  # convergence is quadratic: the next change is below float32 precision
            break
    return 2.0 * mu * (F - R) * wp.transpose(F) + lam * J * (J - 1.0) * wp.identity(n=3, dtype=float)


@wp.func
def _von_mises(e: wp.vec3, mu: float, plastic: wp.vec3, state: float, dt: float) -> wp.vec4:
    """Return mapping: Hencky strains (xyz) and accumulated plastic strain (w) after flow to the yield surface."""
    mean = (e[0] + e[1] + e[2]) / 3.0
    dev = e - wp.vec3(mean, mean, mean)
    size = wp.length(dev)
    root = wp.sqrt(2.0 / 3.0)
    hardening = plastic[1]
    strength = plastic[0] + hardening * state
    if strength < RESIDUAL_STRENGTH * plastic[0]:
        strength = RESIDUAL_STRENGTH * plastic[0]
        hardening = 0.0
    excess = 2.0 * mu * size - root * strength
    if excess <= 0.0:
        return wp.vec4(e[0], e[1], e[2], state)
    resist = float(0.0)
    if plastic[2] > 0.0:
        resist = plastic[2] / wp.max(dt, 1e-30)  # dt = 0: no viscoplastic flow
    flow = wp.min(excess / (2.0 * mu + 2.0 / 3.0 * hardening + resist), size)
    e2 = dev * (1.0 - flow / size) + wp.vec3(mean, mean, mean)
    return wp.vec4(e2[0], e2[1], e2[2], state + root * flow)


@wp.func
def _sand(strain: wp.vec3, stiffness: wp.vec3, slope: float, state: float) -> wp.vec4:
    """Return mapping: Hencky strains (xyz) and log volume gain (w) after projection onto the Drucker-Prager cone."""
    third = state / 3.0
    e = strain + wp.vec3(third, third, third)
    trace = e[0] + e[1] + e[2]
    if trace >= 0.0:
        return wp.vec4(0.0, 0.0, 0.0, trace)  # tension: no stress; the volume gain is stored
    mean = trace / 3.0
    dev = e - wp.vec3(mean, mean, mean)
    size = wp.length(dev)
    bulk = (3.0 * stiffness[1] + 2.0 * stiffness[0]) / (2.0 * stiffness[0])
    excess = size + bulk * trace * slope
    if excess > 0.0:
        dev = dev * (1.0 - excess / size)
    return wp.vec4(dev[0] + mean, dev[1] + mean, dev[2] + mean, 0.0)


@wp.func
def material_update(
    model: int, trial: wp.mat33, stiffness: wp.vec3, plastic: wp.vec3, state: float, dt: float
) -> MaterialUpdate:
    """Compute stress and plastic flow of any model of the module's table, without damping.

    `trial` is the trial deformation gradient; `stiffness` is mu, lambda [Pa], eta; for `plastic` and `state` see the
    table; `dt` is in [s].
    """
    out = MaterialUpdate()
    out.F = trial
    out.state = state
    if model == NEO_HOOKEAN:
        out.tau = neo_hookean(trial, stiffness)
        return out
    if model == COROTATED and wp.determinant(trial) > MIN_VOLUME_RATIO:
        out.tau = _corotated(trial, stiffness[0], stiffness[1])  # four times as fast as the SVD below
        return out
    U = wp.mat33()
    V = wp.mat33()
    S = wp.vec3()
    wp.svd3(trial, U, S, V)
    mu = stiffness[0]
    lam = stiffness[1]
    t = wp.vec3()  # principal Kirchhoff stresses
    if model == COROTATED or model == SNOW:  # noqa: SIM109 -- Warp
        if model == SNOW:
            low = 1.0 - plastic[0]
            high = 1.0 + plastic[1]
            kept = wp.vec3(wp.clamp(S[0], low, high), wp.clamp(S[1], low, high), wp.clamp(S[2], low, high))
            gain = wp.max(S[0] * S[1] * S[2], 1e-6) / (kept[0] * kept[1] * kept[2])
            out.state = state + wp.log(gain)
            S = kept
            out.F = U * wp.diag(S) * wp.transpose(V)
            hardening = wp.min(wp.exp(plastic[2] * (1.0 - wp.exp(out.state))), MAX_SNOW_HARDENING)
            mu = mu * hardening
            lam = lam * hardening
        J = S[0] * S[1] * S[2]
        volumetric = lam * J * (J - 1.0)
        for axis in range(3):
            t[axis] = 2.0 * mu * (S[axis] - 1.0) * S[axis] + volumetric
    else:
        e = wp.vec3(
            wp.log(wp.max(S[0], MIN_VOLUME_RATIO)),
            wp.log(wp.max(S[1], MIN_VOLUME_RATIO)),
            wp.log(wp.max(S[2], MIN_VOLUME_RATIO)),
        )
        mapped = wp.vec4()
        if model == SAND:  # noqa: SIM108 -- Warp's ternary evaluates both
            mapped = _sand(e, stiffness, plastic[0], state)
        else:
            mapped = _von_mises(e, mu, plastic, state, dt)
        e = wp.vec3(mapped[0], mapped[1], mapped[2])
        out.state = mapped[3]
        out.F = U * wp.diag(wp.vec3(wp.exp(e[0]), wp.exp(e[1]), wp.exp(e[2]))) * wp.transpose(V)
        trace = lam * (e[0] + e[1] + e[2])
        t = 2.0 * mu * e + wp.vec3(trace, trace, trace)
    out.tau = U * wp.diag(t) * wp.transpose(U)
    return out


def maxwell_branches(loss: float, omega: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the moduli, relative to the elastic ones, and the relaxation rates [1/s] of two Maxwell branches.

    The loss factor tan(delta) equals `loss` at the angular frequencies omega [rad/s] and omega / BRANCH_RATIO. Between
    them it is at most 1.1 times `loss` for a loss up to .3, and 1.3 times for MAX_LOSS; at 2 omega and at half the
    lower frequency it is .6 to .8 times `loss`. Raises ValueError for a loss above MAX_LOSS.
    """
    if not 0 <= loss <= MAX_LOSS:
        raise ValueError(f"a loss factor of {loss:g} is not between 0 and {MAX_LOSS:g}")
    rates = np.array([omega, omega / BRANCH_RATIO])
    x = rates[:, None] / rates  # frequency (row) over relaxation rate of the branch (column)
    fast, slow = np.linalg.solve((x - loss * x**2) / (1 + x**2), np.full(2, loss))
    return (float(fast), float(slow)), (float(rates[0]), float(rates[1]))


def sand_slope(degrees: float) -> float:
    """Slope of the Drucker-Prager cone for a friction angle [degrees], in Klar's form: |dev tau| = 3 slope x pressure.

    Matches Mohr-Coulomb in plane strain without dilatancy, where shear = sin(angle) x pressure. Klar's own choice,
    sqrt(2/3) 2 sin / (3 - sin), matches triaxial compression and is a third stronger in shear.
    """
    return math.sqrt(2) / 3 * math.sin(math.radians(degrees))


def corotated_reference(F: Tensor, mu: float, lam: float) -> Tensor:
    """Fixed-corotated Kirchhoff stress (p, 3, 3), 2 mu (F - R) F^T + lambda J (J - 1) I, in PyTorch."""
    U, S, Vh = torch.linalg.svd(F)
    flip = torch.linalg.det(U @ Vh).sign()
    R = U @ torch.diag_embed(torch.stack([torch.ones_like(flip), torch.ones_like(flip), flip], -1)) @ Vh
    J = torch.linalg.det(F)[:, None, None]
    return 2 * mu * (F - R) @ F.mT + lam * J * (J - 1) * torch.eye(3).to(F)
