"""Axes and units that imported particles are brought to."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cconv.data.importing.particles import Particles
from cconv.data.limits import one_line
from cconv.errors import ConfigError, DataError, did_you_mean

AXES = "xyz"
DIMENSIONS = ("length", "time", "mass")
UNITS = {  # dimension, and size in metres, seconds or kilograms
    "nm": ("length", 1e-9), "um": ("length", 1e-6), "mm": ("length", 1e-3), "cm": ("length", 1e-2),
    "m": ("length", 1.0), "km": ("length", 1e3), "in": ("length", 0.0254), "ft": ("length", 0.3048),
    "us": ("time", 1e-6), "ms": ("time", 1e-3), "s": ("time", 1.0), "min": ("time", 60.0), "h": ("time", 3600.0),
    "mg": ("mass", 1e-6), "g": ("mass", 1e-3), "kg": ("mass", 1.0), "t": ("mass", 1e3),
}  # fmt: skip
SMALLEST, LARGEST = 1e-12, 1e12  # factors


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """How numbers of the files become those of the data set.

    Attributes:
        axes: For each axis of the data set the axis of the files and its sign; None leaves them as they are.
        length: Length of the data set that is 1 in the files.
        time: The same of times.
        mass: The same of masses.
    """

    axes: tuple[tuple[int, int], ...] | None = None
    length: float = 1.0
    time: float = 1.0
    mass: float = 1.0

    def of(self, particles: Particles) -> Particles:
        """Particles in the axes and units of the data set; densities, which only tell masses, stay as they are.

        Raises:
            DataError: If vectors have another number of components than there are axes.
        """
        factors: dict[str, float] = {
            "velocity": self.length / self.time,
            "spacing": self.length,
            "viscosity": self.length**2 / self.time,
            "mass": self.mass,
        }
        values = {name: _scaled(each, factors.get(name, 1.0)) for name, each in particles.values.items()}
        turned = {name: self._turned(each, name, particles.file) for name, each in values.items() if each.ndim == 2}
        positions = self._turned(_scaled(particles.positions, self.length), "position", particles.file)
        return replace(particles, positions=positions, values=values | turned)

    def _turned(self, vectors: np.ndarray, name: str, file: Path) -> np.ndarray:
        if self.axes is None:
            return vectors
        if vectors.shape[1] != len(self.axes):
            raise DataError(
                f"{file}: the {name} has {vectors.shape[1]} components, and `--axes` names {len(self.axes)} axes; name "
                "as many."
            )
        order, signs = zip(*self.axes, strict=True)
        return vectors[:, list(order)] * np.array(signs, dtype=vectors.dtype)

    @property
    def text(self) -> str:
        """What is done, in words; empty if nothing is."""
        parts = [f"{name} times {getattr(self, name):g}" for name in DIMENSIONS if getattr(self, name) != 1]
        if self.axes is not None:
            named = (f"{'-' if sign < 0 else ''}{AXES[axis]}" for axis, sign in self.axes)
            parts.append(f"axes {', '.join(named)} of the files")
        return "; ".join(parts)


def _scaled(values: np.ndarray, factor: float) -> np.ndarray:
    return values if factor == 1 else (values * factor).astype(values.dtype)


def parse_axes(text: str) -> tuple[tuple[int, int], ...]:
    """Axes of the files that become those of the data set, with their signs, from text such as "x,z,-y".

    Raises:
        ConfigError: If they are not all axes up to a number of them, each once.
    """
    parts = [part.strip() for part in text.split(",")]
    letters = [part.removeprefix("-") for part in parts]
    if sorted(letters) != sorted(AXES[: len(parts)]):
        raise ConfigError(
            f"`--axes` must name each axis of the files once, such as x,z,-y or in two dimensions y,-x, got "
            f"{one_line(text, 40)!r}."
        )
    return tuple((AXES.index(letter), -1 if part[0] == "-" else 1) for letter, part in zip(letters, parts, strict=True))


def parse_units(text: str) -> dict[str, float]:
    """Factors by dimension from units of the files, such as "mm,ms", or from factors, such as "length=0.05".

    Raises:
        ConfigError: If a unit is not known, a factor is none, or a dimension stands there twice.
    """
    factors: dict[str, float] = {}
    for item in (part.strip() for part in text.split(",")):
        dimension, factor = _factor(item) if "=" in item else UNITS.get(item, ("", 0.0))
        if dimension not in DIMENSIONS:
            raise ConfigError(
                f"`--units` must be units such as mm,ms,g, or factors such as length=0.05, got {one_line(item, 40)!r}."
                f"{did_you_mean(item, UNITS)} Units: {', '.join(UNITS)}."
            )
        if not SMALLEST <= factor <= LARGEST:
            raise ConfigError(f"`--units` must have factors from {SMALLEST:g} to {LARGEST:g}, got {item!r}.")
        if dimension in factors:
            raise ConfigError(f"`--units` must give one unit of {dimension}, got {one_line(text, 40)!r}.")
        factors[dimension] = factor
    return factors


def _factor(item: str) -> tuple[str, float]:
    dimension, _, number = (part.strip() for part in item.partition("="))
    try:
        return dimension, float(number)
    except ValueError:
        return "", 0.0
