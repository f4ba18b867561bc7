"""Masses of imported particles: given, stored, or from their densities."""

from dataclasses import dataclass

import numpy as np

from cconv.data.importing.particles import Particles
from cconv.data.source import STORED
from cconv.data.trajectory import ParticleType

SEVERAL_PHASES = 1.2  # ratio of densities in the first frame beyond which particles have masses of their own


@dataclass(frozen=True)
class Masses:
    """Masses of particles: given, stored, from densities, or none.

    Attributes:
        source: Where they come from, in words.
        mass: One for all, or None.
        field: Field that holds them, or None.
        factor: What values of the field are multiplied by.
    """

    source: str
    mass: float | None
    field: str | None
    factor: float

    @classmethod
    def of(cls, first: Particles, given: float | None, volume: float) -> "Masses":
        """Decide by the first frame; `volume` is what a density in the units of the files becomes a mass by."""
        if given is not None:
            return cls(f"given: {given:g}", given, None, 1.0)
        if "mass" in first.values and (first.values["mass"] > 0).all():
            return cls(STORED, None, "mass", 1.0)
        if "density" in first.values and (first.values["density"] > 0).all():
            densities = first.values["density"][first.types == ParticleType.FLUID].astype(np.float64)
            low, middle, high = np.quantile(densities, (0.02, 0.5, 0.98))
            if high > SEVERAL_PHASES * low:
                return cls("density of each particle in the first frame times its volume", None, "density", volume)
            return cls(f"median density {middle:.6g} of the first frame times the volume", middle * volume, None, 1.0)
        return cls("none: rest density 1 times the volume", None, None, volume)

    @property
    def is_nothing(self) -> bool:
        """Whether there are no masses, which the data set says by itself."""
        return self.mass is None and self.field is None

    def values(self, particles: Particles, added: int) -> np.ndarray | None:
        """Masses (N,) of the particles, and of `added` wall particles, as heavy as most; None if there are none."""
        if self.mass is not None:
            return np.full(len(particles) + added, self.mass)
        if self.field is None:
            return None
        masses = particles.values[self.field] * self.factor
        return np.append(masses, np.full(added, np.median(masses))).astype(masses.dtype)
