"""D2 of the thesis: the material rate of density."""

from jaxtyping import Float
from torch import Tensor

from cconv.nn.kinds import Kinds
from cconv.sph.compiled import CompiledSums
from cconv.sph.operators import density_rate
from cconv.tasks.features import FluidState
from cconv.tasks.inputs import Units
from cconv.tasks.task import FieldTask


class DensityRate(FieldTask):
    """The material rate of density Dρ/Dt by the continuity equation over fluid particles (thesis eq. D2)."""

    name = "density_rate"
    symbol = "Dρ/Dt"
    meaning = (
        "The rate at which the density of each particle changes, as a sum over its neighbours in smoothed particle "
        "hydrodynamics (SPH)."
    )
    output = Kinds(1, 0)
    checks = ("regimes", "stress", "still", "precision", "density")

    def field(self, state: FluidState) -> Float[Tensor, "N 1"]:
        """Rates of density (N, 1)."""
        return density_rate(state.masses, state.velocities, state.edges, state.kernel)[:, None]

    def unit(self, units: Units) -> float | Tensor:
        """Rest density a frame's time."""
        return units.density / units.time

    def magnitude(self, density: float, speed: float, length: float) -> float:
        """The density in the time that the flow takes for the length."""
        return density * speed / length

    def compiled_field(self, sums: CompiledSums, state: FluidState) -> Float[Tensor, " N"]:
        """Rates of density (N,) by compiled sums."""
        return sums.density_rate(state.masses, state.velocities, state.edges)
