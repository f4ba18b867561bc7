"""The acceleration that leads to the next stored frame."""

from cconv.nn.kinds import Kinds
from cconv.tasks.features import (
    ACCELERATIONS,
    CONSTANT,
    DENSITY,
    FORCE,
    PARTICLE_TYPE,
    VELOCITY,
    WALLS,
    Units,
)
from cconv.tasks.integrators import SemiImplicitEuler
from cconv.tasks.task import StepTask


class Acceleration(StepTask):
    """Second difference of the positions at the present frame.

    Features: the velocity, the last displacement, which networks know only as differences where their messages take
    differences of vectors; the `history - 2` accelerations before; SPH density; whether a particle is one of a wall;
    a constant external force. Source: Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph
    Networks" (ICML 2020), section 4.1, whose velocities are those sums; LagrangeBench (Toshev et al., 2023).
    """

    name = "acceleration"
    symbol = "a"
    meaning = (
        "The change of each particle's displacement from one stored frame to the next, from which the next frame "
        "follows; a model is rolled out by its own answers."
    )
    output = Kinds(0, 1)
    features = (CONSTANT, DENSITY, PARTICLE_TYPE, ACCELERATIONS, FORCE, VELOCITY, WALLS)
    optional = (DENSITY, PARTICLE_TYPE, ACCELERATIONS, FORCE, WALLS)
    checks = ("completion", "motion", "packing", "perturbed_starts", "mapped_starts", "later_start")
    integrator = SemiImplicitEuler()

    def unit(self, units: Units) -> float:
        """A particle spacing per frame, squared."""
        return units.length
