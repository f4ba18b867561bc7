"""What is asked of a network: what it is given, what it has to answer."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from cconv.data.trajectory import Frame, Scene
from cconv.data.window import Window
from cconv.errors import ConfigError, did_you_mean, shown
from cconv.nn.kinds import Kinds
from cconv.sph.compiled import CompiledSums
from cconv.sph.kernels import AbstractKernel, kernel_named
from cconv.tasks.external_force import WithForceOfScene
from cconv.tasks.features import (
    CONSTANT,
    DENSITY,
    VELOCITY,
    WALLS,
    FluidState,
    fluid_state,
    kinds_of,
    make_inputs,
    window_state,
)
from cconv.tasks.inputs import Inputs, Units
from cconv.tasks.integrators import Integrator


@dataclass(frozen=True)
class Task(ABC):
    """What is asked of a network.

    Attributes:
        kernel: Field name of the SPH kernel of densities and fields.
        relative_smoothing_length: Its h in particle spacings.
        history: Frames that an answer depends on, the present one among them.
    """

    name: ClassVar[str]
    symbol: ClassVar[str]  # of the answer, for charts
    meaning: ClassVar[str]  # of the answer, a sentence for readers
    objective: ClassVar[str]  # what models are compared by, of `cconv.evaluation.objectives`
    output: ClassVar[Kinds]
    features: ClassVar[tuple[str, ...]]
    optional: ClassVar[tuple[str, ...]]  # which models may do without
    on_request: ClassVar[tuple[str, ...]] = ()  # those of them that models have only where a study names them
    checks: ClassVar[tuple[str, ...]]  # of stability, that models must pass: names in `cconv.evaluation.checks`
    histories: ClassVar[tuple[int, int]] = (1, 1)  # the shortest and the longest

    kernel: str = "cubic_spline"
    relative_smoothing_length: float = 1.0
    history: int = 1

    @abstractmethod
    def unit(self, units: Units) -> float | Tensor:
        """What networks predict multiples of, in the units of the data; of several windows perhaps (N, 1)."""

    @abstractmethod
    def inputs(self, observed: Any, scene: Scene, names: Collection[str]) -> Inputs:
        """What a network that takes some features is given.

        Args:
            observed: A frame for a field, a window for a step.
            scene: Its scene.
            names: Features of the task.
        """

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

    @classmethod
    def check_history(cls, history: int) -> None:
        """Check that an answer can depend on so many frames.

        Raises:
            ConfigError: If there are too few or too many.
        """
        shortest, longest = cls.histories
        if not shortest <= history <= longest:
            allowed = f"{shortest}" if shortest == longest else f"{shortest} to {longest}"
            raise ConfigError(f"`history` must be {allowed} for the task {cls.name!r}, got {history}")

    def kinds(self, names: Collection[str]) -> Kinds:
        """How many of the features with these names are scalars and how many vectors."""
        return kinds_of(tuple(names), self.history)

    def kernel_at(self, particle_spacing: float, dim: int) -> AbstractKernel:
        """SPH kernel in data of some particle spacing."""
        return kernel_named(self.kernel)(self.relative_smoothing_length * particle_spacing, dim)


@dataclass(frozen=True)
class FieldTask(Task):
    """A field that analytic SPH gives as a function of the present frame."""

    objective = "normalized_mse"
    features = (CONSTANT, DENSITY, VELOCITY, WALLS)
    optional = (WALLS, DENSITY)

    @abstractmethod
    def field(self, state: FluidState) -> Float[Tensor, "N C"]:
        """Analytic field (N, C) at the fluid particles, in the units of the data."""

    @abstractmethod
    def magnitude(self, density: float, speed: float, length: float) -> float:
        """Size of the field where the density differs by so much over a length, in a flow of some speed."""

    @abstractmethod
    def compiled_field(self, sums: CompiledSums, state: FluidState) -> Tensor:
        """The field as a user computes it who wants it fast, from particles in float32; timed beside the networks."""

    def state(self, frame: Frame, scene: Scene) -> FluidState:
        """Fluid particles of a frame as the analytic field needs them."""
        return fluid_state(frame, scene.box, self.kernel_at(scene.particle_spacing, scene.dim))

    def inputs(self, observed: Frame, scene: Scene, names: Collection[str]) -> Inputs:
        """What a network that takes some features is given of a frame."""
        return make_inputs(self.state(observed, scene), observed.boundary, scene, names)


@runtime_checkable
class Predictor(Protocol):
    """A model of a step that answers before another one does."""

    task: Any

    def answer(self, observed: Window, scene: Scene) -> Tensor:
        """Answer (M, D) for each of the M fluid particles at the end of a window, differentiable."""


@dataclass(frozen=True)
class StepTask(Task):
    """The step to the next stored frame, from a window of frames up to the present one.

    With a predictor, a network corrects its step: it is given the window that the predictor's answer leads to, and has
    to answer what remains. So it sees where particles are about to come too close, which decides how they push each
    other during a frame that is many solver steps long.

    Attributes:
        moved_by: Turns whole accelerations into the next frame.
        force_travel: Standard deviation of the displacements of a frame along an axis, in particle spacings, where the
            integrator adds the external force of the scene, smoothed over so much; None where networks know the force
            or learn it.
        predictor: Model of a step that answers first; None without one.
    """

    moved_by: ClassVar[Integrator]
    objective = "rollout_mse"
    histories = (2, 20)

    history: int = 6
    force_travel: float | None = None
    predictor: Predictor | None = None

    @property
    def integrator(self) -> Integrator:
        """Turns answers into the next frame, and the next frame into the answer that leads to it."""
        return self.moved_by if self.force_travel is None else WithForceOfScene(self.moved_by, self.force_travel)

    def correcting(self, predictor: Predictor) -> "StepTask":
        """The task of correcting the step of a predictor.

        Raises:
            ConfigError: If the predictor is for another task or depends on more frames.
        """
        self.check_predictor(predictor.task)
        return replace(self, predictor=predictor)

    def check_predictor(self, asked: Task) -> None:
        """Check that a model of some task can answer before one of this task does.

        Raises:
            ConfigError: If it is another task, depends on more frames, or leaves another force to its integrator.
        """
        if not isinstance(asked, StepTask) or asked.name != self.name:
            raise ConfigError(f"the predictor must be a model of the task {self.name!r}, and is one of {asked.name!r}")
        if asked.history > self.history:
            raise ConfigError(
                f"`history` must be at least {asked.history}, the predictor's, got {self.history}; raise it, or fit "
                "the predictor with a shorter one"
            )
        if asked.force_travel != self.force_travel:
            raise ConfigError(
                "the external force must be added by the integrator of both predictor and network, or by none"
            )

    def target(self, window: Window, scene: Scene) -> Float[Tensor, "M C"]:
        """Answer (M, C) that leads the fluid to the first frame of the window's future, in the units of the data."""
        return self.integrator.target(window, scene)

    def inputs(self, observed: Window, scene: Scene, names: Collection[str]) -> Inputs:
        """What a network that takes some features is given of a window as the integrator, or a predictor, moves it.

        Wall particles are particles like others, which send and receive, but no answer is asked for them. Boundary
        points count only where there are none.
        """
        known = None if self.predictor is None else self.predictor.answer(observed, scene)
        if known is None:
            observed = self.integrator.before(observed, scene)
        else:
            observed = self.integrator.advance(observed, known, scene)
        kernel = self.kernel_at(scene.particle_spacing, scene.dim)
        boundary = observed.boundary if bool(observed.is_fluid.all()) else None
        state = window_state(observed, self.history, boundary, scene, kernel)
        return replace(make_inputs(state, boundary, scene, names), answered=observed.is_fluid, known=known)


def as_field(task: Task) -> FieldTask:
    """The task, if it is a field of the present frame.

    Raises:
        ConfigError: If it is a step.
    """
    if not isinstance(task, FieldTask):
        raise ConfigError(f"the task {task.name!r} is a step, and only fields are possible here, e.g. 'density_rate'.")
    return task


def as_step(task: Task) -> StepTask:
    """The task, if it is the step to the next frame.

    Raises:
        ConfigError: If it is a field.
    """
    if not isinstance(task, StepTask):
        raise ConfigError(f"the task {task.name!r} is a field, and only steps are possible here, e.g. 'acceleration'.")
    return task
