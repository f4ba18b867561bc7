"""What a network is given: values of particles by name, their places, and what these numbers are multiples of.

Networks know no metres, kilograms or seconds: lengths are in particle spacings, densities in rest densities, times in
intervals of stored frames. So a network holds at every resolution and in all units.

Inputs of several windows stand in one graph: their particles one window after another, with a batch index.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cconv.batching import counts_of, index_of
from cconv.data.trajectory import Scene
from cconv.devices import moved
from cconv.domain import Box
from cconv.errors import ShapeError
from cconv.nn.kinds import Kinds, join_kinds, split_kinds


@dataclass(frozen=True, kw_only=True)
class Units:
    """What a network's numbers are multiples of, in the units of the data.

    Attributes:
        length: Particle spacing dx.
        density: Rest density, mean mass of a fluid particle / dx^D; of several windows, the one of each particle's
            window (N, 1), float64.
        time: Time between stored frames.
    """

    length: float | Float[Tensor, ""]
    density: float | Float[Tensor, ""] | Float[Tensor, "N 1"]
    time: float | Float[Tensor, ""]

    def to(self, device: torch.device) -> "Units":
        """The same on a device."""
        return moved(self, device, ("density",))

    @property
    def velocity(self) -> float | Tensor:
        """Spacings in a frame's time."""
        return self.length / self.time

    @property
    def acceleration(self) -> float | Tensor:
        """Spacings in a frame's time, squared."""
        return self.length / self.time**2


def units_of(masses: Float[Tensor, " N"], scene: Scene) -> Units:
    """Units of a frame whose fluid particles have masses (N,)."""
    mean_mass = float(masses.double().mean()) if len(masses) else 1.0
    return Units(
        length=scene.particle_spacing, density=mean_mass / scene.particle_spacing**scene.dim, time=scene.frame_dt
    )


def spread_densities(units: Sequence[Units], batch_index: Int[Tensor, " N"]) -> Float[Tensor, "N 1"]:
    """Rest density of each particle (N, 1) of several windows, from the units of each window."""
    densities = torch.tensor([each.density for each in units], dtype=torch.float64, device=batch_index.device)
    return densities[batch_index][:, None]


@dataclass(frozen=True, kw_only=True)
class Features:
    """Named values of particles; scalars come first, everywhere.

    Attributes:
        scalars: (N, S).
        vectors: (N, V, D).
        scalar_names: Names of the scalars, S.
        vector_names: Names of the vectors, V; those of one feature, e.g. of a history, share its name.
    """

    scalars: Float[Tensor, "N S"]
    vectors: Float[Tensor, "N V D"]
    scalar_names: tuple[str, ...]
    vector_names: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scalars, then of the vectors."""
        return self.scalar_names + self.vector_names

    @property
    def kinds(self) -> Kinds:
        """Numbers of scalars and vectors."""
        return Kinds(len(self.scalar_names), len(self.vector_names))

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of the scalar or vector that each column of `flat` belongs to, S + V · D."""
        dim = self.vectors.shape[2]
        return self.scalar_names + tuple(name for name in self.vector_names for _ in range(dim))

    def flat(self) -> Float[Tensor, "N C"]:
        """Scalars and the components of the vectors, (N, S + V · D)."""
        return join_kinds(self.scalars, self.vectors)

    def with_values(self, flat: Float[Tensor, "M C"]) -> "Features":
        """Features of the same names with other values, in the order of `flat`, (M, S + V · D)."""
        scalars, vectors = split_kinds(flat, self.kinds, self.vectors.shape[2])
        return replace(self, scalars=scalars, vectors=vectors)

    def named(self, name: str) -> Float[Tensor, "N ..."]:
        """Return the first scalar (N,) or vector (N, D) of a name."""
        if name in self.scalar_names:
            return self.scalars[:, self.scalar_names.index(name)]
        return self.vectors[:, self.vector_names.index(name)]

    def select(self, names: Collection[str]) -> "Features":
        """Those of some names, in their own order.

        Raises:
            ShapeError: If one is not among them.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise ShapeError(
                f"The model takes the feature {missing[0]!r}, and the inputs hold {', '.join(self.names)}."
            )
        if set(names) == set(self.names):
            return self
        scalars = [place for place, name in enumerate(self.scalar_names) if name in names]
        vectors = [place for place, name in enumerate(self.vector_names) if name in names]
        return Features(
            scalars=self.scalars[:, scalars],
            vectors=self.vectors[:, vectors],
            scalar_names=tuple(self.scalar_names[place] for place in scalars),
            vector_names=tuple(self.vector_names[place] for place in vectors),
        )

    def to(self, to: torch.dtype | torch.device) -> "Features":
        """The same in another type of numbers, or on a device."""
        return replace(self, scalars=self.scalars.to(to), vectors=self.vectors.to(to))

    def separated(self, counts: Sequence[int]) -> list["Features"]:
        """Return the features of each of several windows with so many particles."""
        parts = zip(self.scalars.split(counts), self.vectors.split(counts), strict=True)
        return [replace(self, scalars=scalars, vectors=vectors) for scalars, vectors in parts]


def join_features(parts: Sequence[Features]) -> Features:
    """Features of the particles of several windows, which have the same names."""
    scalars, vectors = (torch.cat([getattr(part, name) for part in parts]) for name in ("scalars", "vectors"))
    return replace(parts[0], scalars=scalars, vectors=vectors)


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The particles of a frame, or of several windows, as a network sees them, in `units`.

    Attributes:
        positions: (N, D), particle spacings.
        features: Features of each particle; the first scalar is a constant.
        wall_positions: (B, D), particle spacings, or None where the scene has no walls.
        wall_features: Normals, or a constant where the data hold none; None without walls.
        box: Bounds and periodic axes, particle spacings.
        units: What these numbers are multiples of.
        answered: Which particles the network has to answer for, (N,), bool: the fluid; None for all.
        known: What a predictor has answered for them already, (M, D), in the units of the data: the network has to
            answer what remains. None without a predictor.
        batch_index: Window that each particle belongs to, (N,), ascending, if there are several; None for one.
        wall_batch_index: The same of wall points, (B,).
    """

    positions: Float[Tensor, "N D"]
    features: Features
    wall_positions: Float[Tensor, "B D"] | None
    wall_features: Features | None
    box: Box
    units: Units
    answered: Bool[Tensor, " N"] | None = None
    known: Float[Tensor, "M D"] | None = None
    batch_index: Int[Tensor, " N"] | None = None
    wall_batch_index: Int[Tensor, " B"] | None = None

    @property
    def num_particles(self) -> int:
        """Number of particles N."""
        return len(self.positions)

    @property
    def num_answers(self) -> int:
        """Number of particles that the network has to answer for, M."""
        return self.num_particles if self.answered is None else int(self.answered.sum())

    @property
    def answer_counts(self) -> list[int]:
        """Numbers of particles of each window that the network has to answer for."""
        if self.batch_index is None:
            return [self.num_answers]
        windows = int(self.batch_index[-1]) + 1
        return counts_of(self.batch_index if self.answered is None else self.batch_index[self.answered], windows)

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return self.positions.shape[1]

    @property
    def wall_kinds(self) -> Kinds | None:
        """What a wall point carries; None without walls."""
        return None if self.wall_features is None else self.wall_features.kinds

    def to(self, device: torch.device) -> "Inputs":
        """The same on a device."""
        return moved(self.read_on(device), device, ("units", "known"))

    def read_on(self, device: torch.device) -> "Inputs":
        """What a network reads on a device; units and a predictor's answer, for which it may lack float64, stay."""
        points = ("positions", "features", "wall_positions", "wall_features")
        return moved(self, device, (*points, "answered", "batch_index", "wall_batch_index"))

    def double(self) -> "Inputs":
        """The same in float64."""
        return replace(
            self,
            positions=self.positions.double(),
            features=self.features.to(torch.float64),
            wall_positions=None if self.wall_positions is None else self.wall_positions.double(),
            wall_features=None if self.wall_features is None else self.wall_features.to(torch.float64),
        )

    def separated(self) -> list["Inputs"]:
        """Return the inputs of each window."""
        if self.batch_index is None:
            return [self]
        counts = counts_of(self.batch_index)
        walls = self._separated_walls(len(counts))
        densities = (
            torch.as_tensor(self.units.density, device=self.positions.device)
            .expand(self.num_particles, 1)
            .split(counts)
        )
        answered = [None] * len(counts) if self.answered is None else self.answered.split(counts)
        known = [None] * len(counts) if self.known is None else self.known.split(self.answer_counts)
        parts = zip(
            self.positions.split(counts),
            self.features.separated(counts),
            densities,
            answered,
            known,
            walls,
            strict=True,
        )
        return [
            Inputs(
                positions=positions,
                features=features,
                wall_positions=points,
                wall_features=of_points,
                box=self.box,
                units=replace(self.units, density=float(density[0])),
                answered=asked,
                known=told,
            )
            for positions, features, density, asked, told, (points, of_points) in parts
        ]

    def _separated_walls(self, windows: int) -> list[tuple[Tensor | None, Features | None]]:
        """Points and features of the walls of each window."""
        if self.wall_positions is None or self.wall_features is None or self.wall_batch_index is None:
            return [(None, None)] * windows
        counts = counts_of(self.wall_batch_index, windows)
        return list(zip(self.wall_positions.split(counts), self.wall_features.separated(counts), strict=True))


def join_inputs(parts: Sequence[Inputs]) -> Inputs:
    """Inputs of several windows, at least one, whose particles stand one window after another.

    Args:
        parts: Inputs of each window, in the same box, with walls or answers for some particles in all or none.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    index = index_of([part.num_particles for part in parts], first.positions.device)
    points = [part.wall_positions for part in parts if part.wall_positions is not None]
    of_points = [part.wall_features for part in parts if part.wall_features is not None]
    answered = [part.answered for part in parts if part.answered is not None]
    known = [part.known for part in parts if part.known is not None]
    return replace(
        first,
        positions=torch.cat([part.positions for part in parts]),
        features=join_features([part.features for part in parts]),
        wall_positions=torch.cat(points) if points else None,
        wall_features=join_features(of_points) if of_points else None,
        units=replace(first.units, density=spread_densities([part.units for part in parts], index)),
        answered=torch.cat(answered) if answered else None,
        known=torch.cat(known) if known else None,
        batch_index=index,
        wall_batch_index=index_of([len(each) for each in points], points[0].device) if points else None,
    )
