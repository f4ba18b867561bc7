"""The correction of the positions that particles fall to, which leads to the next stored frame."""

from dataclasses import dataclass

from torch import Tensor

from cconv.errors import ConfigError
from cconv.nn.kinds import Kinds
from cconv.tasks.features import CONSTANT, DENSITY, PARTICLE_TYPE, VELOCITY, WALLS
from cconv.tasks.inputs import Units
from cconv.tasks.integrators import CorrectedFall
from cconv.tasks.task import StepTask


@dataclass(frozen=True)
class PositionCorrection(StepTask):
    """What has to be added to the positions after a step under the external force alone.

    Networks are asked about the particles after that step: where they are then, and the velocity that they then have.
    The density is a feature only where it is asked for. Source: Ummenhofer et al., "Lagrangian Fluid Simulation with
    Continuous Convolutions" (ICLR 2020), section 4.

    Raises:
        ConfigError: If the external force is to be added by the integrator once more.
    """

    name = "position_correction"
    symbol = "Δx"
    meaning = (
        "What leads each particle to the next stored frame, from where it would be under the external force alone; "
        "a model is rolled out by its own answers."
    )
    output = Kinds(0, 1)
    features = (CONSTANT, DENSITY, PARTICLE_TYPE, VELOCITY, WALLS)
    optional = (DENSITY, PARTICLE_TYPE, WALLS)
    on_request = (DENSITY,)
    checks = ("completion", "motion", "packing", "perturbed_starts", "mapped_starts", "later_start")
    moved_by = CorrectedFall()

    history: int = 2

    def __post_init__(self) -> None:
        if self.force_travel is not None:
            raise ConfigError(
                f"`task.external_force` must be 'network' for the task {self.name!r}, whose integrator always adds the "
                "force of the scene"
            )

    def unit(self, units: Units) -> float | Tensor:
        """A particle spacing."""
        return units.length
