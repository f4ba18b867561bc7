"""Weakly compressible SPH as sums over all pairs in plain tensor operations: slow, close to the papers' formulas."""

import torch

from cconv.sph.solver import ParticleState


class DenseSPH:
    """Right-hand sides of a state; equations of Adami et al. (2012, 2013)."""

    def __init__(self, state: ParticleState, kernel, box):
        self.state, self.fluid = state, ~state.is_wall
        self.r = box.displacement(state.positions[:, None], state.positions[None])
        distances = self.r.norm(dim=2)
        self.w = kernel.value(distances)
        apart = (distances > 0).double()
        self.slope = apart * kernel.derivative(distances) / (distances + 1 - apart)  # W'/r
        self.distances = distances

    def densities(self):
        """m_i Σ_j W_ij."""
        return self.state.masses * self.w.sum(dim=1)

    def density_rates(self, velocities, densities):
        """ρ_i Σ_j m_j/ρ_j (u_i - u_j)·∇W."""
        difference = velocities[:, None] - velocities[None]
        terms = self.state.masses / densities * (difference * self.r).sum(dim=2) * self.slope
        return densities * terms.sum(dim=1)

    def shepard(self, densities):
        """Σ m_j W / min(1, Σ m_j/ρ_j W)."""
        mass = (self.state.masses * self.w).sum(dim=1)
        volume = (self.state.masses / densities * self.w).sum(dim=1)
        return mass / volume.clamp(max=1)

    def walls(self, pressures, force):
        """Pressures and velocities with those of walls extrapolated from the fluid (2012, eqs. 22, 23, 27)."""
        state, weights = self.state, self.w * self.fluid
        total = weights.sum(dim=1)
        safe = torch.where(total > 0, total, 1.0)
        column = (force[:, None] * self.r).sum(dim=2)
        pressure = (weights * (pressures + state.densities * column)).sum(dim=1) / safe
        extrapolated = [
            torch.where(total[:, None] > 0, 2 * state.velocities - weights @ field / safe[:, None], state.velocities)
            for field in (state.velocities, state.transport_velocities)
        ]
        wall = state.is_wall
        return (
            torch.where(wall, torch.where(total > 0, pressure, 0.0), pressures),
            torch.where(wall[:, None], extrapolated[0], state.velocities),
            torch.where(wall[:, None], extrapolated[1], state.transport_velocities),
        )

    def accelerations(self, p, u, v, rho, eta, friction_at_walls, transport_pressure, alpha, sound_speed, h):
        """Accelerations without force, and those of the transport velocity (2013, eqs. 8 and 13; 2012, eq. 11)."""
        m, wall = self.state.masses, self.state.is_wall
        volumes = (m / rho) ** 2
        c = (volumes[:, None] + volumes[None]) / m[:, None] * self.slope
        pressure = (rho[None] * p[:, None] + rho[:, None] * p[None]) / (rho[:, None] + rho[None])
        mean_eta = 2 * eta[:, None] * eta[None] / (eta[:, None] + eta[None])
        if not friction_at_walls:
            mean_eta = mean_eta * ~wall
        stress = (rho[:, None] * u)[:, :, None] * (v - u)[:, None, :]
        both = (stress[:, None] + stress[None]) / 2
        du = u[:, None] - u[None]
        a = c[..., None] * (
            -pressure[..., None] * self.r + torch.einsum("ijab,ijb->ija", both, self.r) + mean_eta[..., None] * du
        )
        closing = (du * self.r).sum(dim=2) / ((rho[:, None] + rho[None]) / 2 * (self.distances**2 + 0.01 * h**2))
        pairs = self.fluid[:, None] & self.fluid[None]
        a = a + (m * alpha * h * sound_speed * closing * self.slope * pairs)[..., None] * self.r
        shift = -transport_pressure * c[..., None] * self.r
        only_fluid = self.fluid[:, None]
        return a.sum(dim=1) * only_fluid, shift.sum(dim=1) * only_fluid
