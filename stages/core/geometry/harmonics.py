"""Real spherical harmonics of degree 0 to 3, in the order and signs that 3D Gaussian files use."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))


def degree_of(k: int) -> int:
    """Degree of a set of k = (degree + 1)^2 coefficients. Raises ValueError unless it is 0 to 3."""
    degree = round(k**0.5) - 1
    if (degree + 1) ** 2 != k or not 0 <= degree <= 3:
        raise ValueError(f"{k} coefficients are not a full set of degree 0 to 3")
    return degree


def basis(dirs: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """The (degree + 1)^2 basis functions at unit directions.

    Source: Ramamoorthi and Hanrahan 2001, with the Condon-Shortley phase, as in Kerbl et al. 2023.
    """
    x, y, z = dirs.unbind(-1)
    terms = [torch.full_like(x, C0)]
    if degree >= 1:
        c = 0.4886025119029199  # sqrt(3 / (4 pi))
        terms += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = 1.0925484305920792  # sqrt(15 / (4 pi))
        terms += [c * x * y, -c * y * z, 0.31539156525252005 * (3 * z * z - 1), -c * x * z, 0.5 * c * (x * x - y * y)]
    if degree >= 3:
        a, b, c = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
        terms += [
            -a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1), 0.5 * b * z * (x * x - y * y), -a * x * (x * x - 3 * y * y),
        ]  # fmt: skip
    return torch.stack(terms, -1)


def evaluate_sh(sh: Float[Tensor, "n k 3"], dirs: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colour of each Gaussian along unit view directions (camera to Gaussian), not clamped: sh . basis + 0.5."""
    return (basis(dirs, degree_of(sh.shape[1]))[..., None] * sh).sum(1) + 0.5


def rgb_to_sh(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Degree-0 coefficients of RGB colours in 0..1."""
    return ((rgb - 0.5) / C0)[:, None]


@cache
def probes() -> tuple[Tensor, dict[int, Tensor]]:
    """Fixed unit directions, and for each band the pseudo-inverse that maps function values there to coefficients."""
    dirs = torch.randn(16, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    dirs = dirs / dirs.norm(dim=-1, keepdim=True)
    values = basis(dirs, 3)
    return dirs, {l: torch.linalg.pinv(values[:, l * l : (l + 1) ** 2]) for l in (1, 2, 3)}


def rotate_sh(sh: Float[Tensor, "n k 3"], R: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients of the colour function rotated by R: new(d) = old(R^T d).

    Bands do not mix under rotation, so each band is sampled at fixed directions and solved for (exact up to rounding).
    """
    degree = degree_of(sh.shape[1])
    if degree == 0:
        return sh
    dirs, inverses = probes()
    dirs = dirs.to(sh)
    values = basis(torch.einsum("nji,dj->ndi", R, dirs), degree)  # the old functions at R^T d
    bands = [sh[:, :1]]
    for l in range(1, degree + 1):
        band = slice(l * l, (l + 1) ** 2)
        D = torch.einsum("md,ndk->nmk", inverses[l].to(sh), values[..., band])
        bands.append(D @ sh[:, band])
    return torch.cat(bands, 1)
