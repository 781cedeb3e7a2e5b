"""gsplat's relocation of dead Gaussians (MCMC) without CUDA."""

import gsplat.relocation
import torch


def relocation(opacities, scales, ratios, binoms, n_max, min_opacity=0.0):
    """Eq. 9 of the MCMC paper: n copies that together look like the old Gaussian."""
    new = (1 - (1 - opacities) ** (1 / ratios)).clamp_min(min_opacity)
    total = torch.zeros_like(opacities)
    for i in range(int(ratios.max())):
        k = torch.arange(i + 1)
        terms = binoms[i, k] * (-1.0) ** k / (k + 1).sqrt() * new[:, None] ** (k + 1)
        total += terms.sum(1) * (i < ratios)
    return new, scales * (opacities / total)[:, None]


gsplat.relocation._make_lazy_cuda_func = {"relocation": relocation}.__getitem__
