"""SPH relaxation as sums over all pairs in plain tensor operations, in units of the particle spacing.

The equations are those of Neural SPH's published code, written down step by step.
"""

import math

import torch

SPEED_OF_SOUND = 10.0


def quintic(q, dim):
    """W and dW/dq for a smoothing length of 1."""
    sigma = {1: 1 / 120, 2: 7 / (478 * math.pi), 3: 1 / (120 * math.pi)}[dim]
    terms = [(factor, (edge - q).clamp(min=0)) for factor, edge in ((1, 3), (-6, 2), (15, 1))]
    values = sum(factor * rest**5 for factor, rest in terms)
    slopes = sum(-5 * factor * rest**4 for factor, rest in terms)
    return sigma * values, sigma * slopes


def dense_relax(positions, before, is_wall, *, box, particle_spacing, alpha, beta, loops):
    """Positions after the shifts; float64."""
    dim, fluid = box.dim, ~is_wall
    for _ in range(loops):
        r = box.displacement(positions[:, None], positions[None]) / particle_spacing
        distance = r.norm(dim=2)
        w, slope = quintic(distance, dim)
        rho = w.sum(dim=1)
        rho = torch.where(rho < 0.98, 1.0, rho).clamp(max=1.02)
        pressure = SPEED_OF_SOUND**2 * (rho - 1)
        u = box.displacement(positions, before) / particle_spacing
        weights = w * fluid
        total = weights.sum(dim=1)
        near = total > 0
        safe = torch.where(near, total, 1.0)
        pressure = torch.where(fluid, pressure, torch.where(near, weights[:, fluid] @ pressure[fluid] / safe, 0.0))
        mirrored = torch.where(near[:, None], 2 * u - weights @ u / safe[:, None], u)
        u = torch.where(fluid[:, None], u, mirrored)
        rho = pressure / SPEED_OF_SOUND**2 + 1
        apart = distance > 0
        along = torch.where(apart, slope / torch.where(apart, distance, 1.0), 0.0)
        weight = (1 / rho**2)[:, None] + (1 / rho**2)[None]
        shared = (rho[None] * pressure[:, None] + rho[:, None] * pressure[None]) / (rho[:, None] + rho[None])
        acceleration = ((weight * along)[:, :, None] * (-shared[:, :, None] * r + beta * (u[:, None] - u[None]))).sum(
            dim=1
        )
        acceleration[is_wall] = 0
        positions = box.wrap(positions + alpha * particle_spacing * acceleration)
    return positions
