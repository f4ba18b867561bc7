"""What is asked of a network: what it is given, what it has to answer."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from cconv.data.trajectory import Frame, Scene
from cconv.errors import ConfigError, did_you_mean, shown
from cconv.nn.kinds import Kinds
from cconv.sph.compiled import CompiledSums
from cconv.sph.kernels import AbstractKernel, kernel_named
from cconv.tasks.features import CONSTANT, DENSITY, VELOCITY, WALLS, FluidState, Inputs, Units, fluid_state, make_inputs


@dataclass(frozen=True)
class FieldTask(ABC):
    """A field that analytic SPH gives as a function of the present frame.

    Attributes:
        kernel: Field name of the SPH kernel of densities and field.
        relative_smoothing_length: Its h in particle spacings.
    """

    name: ClassVar[str]
    symbol: ClassVar[str]  # of the field, for charts
    meaning: ClassVar[str]  # of the field, a sentence for readers
    objective: ClassVar[str] = "normalized_mse"  # what models are compared by, of `cconv.evaluation.objectives`
    output: ClassVar[Kinds]
    features: ClassVar[tuple[str, ...]] = (CONSTANT, DENSITY, VELOCITY, WALLS)
    optional: ClassVar[tuple[str, ...]] = (WALLS, DENSITY)  # which models may do without
    checks: ClassVar[tuple[str, ...]]  # of stability, that models must pass: names in `cconv.evaluation.checks`

    kernel: str = "cubic_spline"
    relative_smoothing_length: float = 1.0

    @abstractmethod
    def field(self, state: FluidState) -> Float[Tensor, "N C"]:
        """Analytic field (N, C) at the fluid particles, in the units of the data."""

    @abstractmethod
    def unit(self, units: Units) -> float:
        """What networks predict multiples of, in the units of the data."""

    @abstractmethod
    def magnitude(self, density: float, speed: float, length: float) -> float:
        """Size of the field where the density differs by so much over a length, in a flow of some speed."""

    @abstractmethod
    def compiled_field(self, sums: CompiledSums, state: FluidState) -> Tensor:
        """The field as a user computes it who wants it fast, from particles in float32; timed beside the networks."""

    @classmethod
    def check_features(cls, names: Collection[str]) -> None:
        """Check that features are those of the task, each once, and that none is missing that no model does without.

        Raises:
            ConfigError: With the feature.
        """
        for name in names:
            if name not in cls.features:
                raise ConfigError(
                    f"no feature {shown(name)}.{did_you_mean(name, cls.features)} Features: {', '.join(cls.features)}"
                )
        for name in cls.features:
            if name not in names and name not in cls.optional:
                raise ConfigError(
                    f"the feature {name!r} must be one of `features`; optional are {', '.join(cls.optional)}"
                )
        if len(set(names)) < len(names):
            raise ConfigError("`features` must hold each name once")

    def kernel_at(self, particle_spacing: float, dim: int) -> AbstractKernel:
        """SPH kernel in data of some particle spacing."""
        return kernel_named(self.kernel)(self.relative_smoothing_length * particle_spacing, dim)

    def state(self, frame: Frame, scene: Scene) -> FluidState:
        """Fluid particles of a frame as the analytic field needs them."""
        return fluid_state(frame, scene.box, self.kernel_at(scene.particle_spacing, scene.dim))

    def inputs(self, frame: Frame, scene: Scene, names: Collection[str]) -> Inputs:
        """What a network that takes some features is given of a frame."""
        return make_inputs(self.state(frame, scene), frame.boundary, scene, names)
