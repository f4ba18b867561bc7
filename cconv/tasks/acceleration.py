"""The acceleration that leads to the next stored frame."""

from torch import Tensor

from cconv.nn.kinds import Kinds
from cconv.tasks.features import (
    ACCELERATIONS,
    CONSTANT,
    DENSITY,
    FORCE,
    PARTICLE_TYPE,
    PRESSURE_SOURCE,
    TYPE_ONE_HOT,
    VELOCITY,
    WALL_DISTANCE,
    WALL_NORMAL,
    WALLS,
)
from cconv.tasks.inputs import Units
from cconv.tasks.integrators import SemiImplicitEuler
from cconv.tasks.task import StepTask


class Acceleration(StepTask):
    """Second difference of the positions at the present frame.

    Features: the velocity, the last displacement, which networks know only as differences where their messages take
    differences of vectors; the `history - 2` accelerations before; SPH density; the source of the pressure, which tells
    a single linear layer what pressure the motion calls for; whether a particle is one of a wall; how near the nearest
    wall point is and the direction away from the walls, both within the support radius of the task's kernel; the type
    as nine zeros and ones, of which networks learn an embedding, only where it is asked for; the external force at the
    particle's place. Wall particles have velocities as well: the difference from a lid that
    slides is its velocity relative to the fluid, and needs no feature of its own. Source: Sanchez-Gonzalez et al.,
    "Learning to Simulate Complex Physics with Graph Networks" (ICML 2020), section 4.1, whose velocities are those
    sums, with distances to walls clipped at the cutoff; LagrangeBench (Toshev et al., 2023).
    """

    name = "acceleration"
    symbol = "a"
    meaning = (
        "The change of each particle's displacement from one stored frame to the next, from which the next frame "
        "follows; a model is rolled out by its own answers."
    )
    output = Kinds(0, 1)
    features = (
        CONSTANT,
        DENSITY,
        PRESSURE_SOURCE,
        PARTICLE_TYPE,
        WALL_DISTANCE,
        TYPE_ONE_HOT,
        ACCELERATIONS,
        FORCE,
        WALL_NORMAL,
        VELOCITY,
        WALLS,
    )
    optional = tuple(name for name in features if name not in (CONSTANT, VELOCITY))
    on_request = (TYPE_ONE_HOT,)
    checks = ("completion", "motion", "packing", "perturbed_starts", "mapped_starts", "later_start")
    moved_by = SemiImplicitEuler()

    def unit(self, units: Units) -> float | Tensor:
        """A particle spacing per frame, squared."""
        return units.length
