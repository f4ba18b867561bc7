"""D3 of the thesis: the gradient of density."""

from jaxtyping import Float
from torch import Tensor

from cconv.nn.kinds import Kinds
from cconv.sph.compiled import CompiledSums
from cconv.sph.operators import density_gradient
from cconv.tasks.features import FluidState
from cconv.tasks.inputs import Units
from cconv.tasks.task import FieldTask


class DensityGradient(FieldTask):
    """The gradient of density ∇ρ over fluid particles (thesis eq. D3)."""

    name = "density_gradient"
    symbol = "∇ρ"
    meaning = (
        "The gradient of the density at each particle, as a sum over its neighbours in smoothed particle hydrodynamics "
        "(SPH)."
    )
    output = Kinds(0, 1)
    checks = ("regimes", "stress", "precision")

    def field(self, state: FluidState) -> Float[Tensor, "N D"]:
        """Gradients of density (N, D)."""
        return density_gradient(state.masses, state.densities, state.edges, state.kernel)

    def unit(self, units: Units) -> float | Tensor:
        """Rest density a particle spacing."""
        return units.density / units.length

    def magnitude(self, density: float, speed: float, length: float) -> float:
        """The density by the length, at any speed."""
        return density / length

    def compiled_field(self, sums: CompiledSums, state: FluidState) -> Float[Tensor, "N D"]:
        """Gradients of density (N, D) by compiled sums; the densities are summed first, as a user has to."""
        return sums.density_gradient(state.masses, sums.density(state.masses, state.edges), state.edges)
