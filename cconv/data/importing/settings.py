"""What a user says about particle files that are to be imported."""

from dataclasses import dataclass, field

from cconv.data.importing.conversion import Conversion
from cconv.data.importing.particles import Types


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """What a user says about the files; None and empty where they are to tell.

    Lengths, times, masses and vectors are in the units and on the axes of the data set.

    Attributes:
        mapping: Names of the arrays of fields.
        types: Meaning of the values of particle types.
        fluid: Number of fluid particles at the beginning of each file; moving walls follow.
        dt: Time between frames.
        name_time: Time of one step of the number in file names.
        particle_spacing: Distance of neighbouring particles at rest.
        mass: Mass of every particle.
        force: Constant external acceleration.
        bounds: Lower and upper bound of each axis.
        periodic: Letters of the periodic axes.
        conversion: Axes and units of the data set.
        separate_frames: Whether each frame becomes a trajectory of its own.
        split_fractions: Shares of train, valid and test.
        gap: Frames dropped between the splits of a single run.
        data_seed: Seed of the permutation of runs.
    """

    mapping: dict[str, tuple[str, ...]] = field(default_factory=dict)
    types: Types | None = None
    fluid: int | None = None
    dt: float | None = None
    name_time: float | None = None
    particle_spacing: float | None = None
    mass: float | None = None
    force: tuple[float, ...] | None = None
    bounds: tuple[tuple[float, float], ...] | None = None
    periodic: str = ""
    conversion: Conversion = Conversion()
    separate_frames: bool = False
    split_fractions: tuple[float, ...] = (0.7, 0.15, 0.15)
    gap: int = 2
    data_seed: int = 0
