"""A model: a task, a network that predicts its target, and the standardisation of features and target."""

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, cast

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor, nn

from cconv.data.trajectory import Frame, ParticleType, Scene
from cconv.data.window import Window
from cconv.devices import FLOAT32, Precision, home_of, products_in
from cconv.errors import ConfigError, ShapeError, shown
from cconv.models.relaxation import Relaxation
from cconv.models.standardization import Standardization, standardize_features, standardize_values, unknown
from cconv.neighbors import radius_graph
from cconv.networks import NetworkTable
from cconv.networks.network import Geometry, Network, NetworkSettings, WallInputs
from cconv.nn.kinds import Kinds
from cconv.ops.workers import results_of
from cconv.sph.kernels import KERNELS, AbstractKernel
from cconv.tasks import TASKS, task_named
from cconv.tasks.features import CONSTANT, WALLS
from cconv.tasks.inputs import Inputs
from cconv.tasks.samples import Sample, StepSample
from cconv.tasks.task import StepTask, Task, as_step
from cconv.validation import Length, Real, StrictModel, Whole, validated

MOST_PARAMETERS = 10**8  # with Adam's moments 1.6 GB


class ModelConfig(StrictModel):
    """Everything that rebuilds a model except its weights; stored as `config.json`.

    The network computes in particle spacings, rest densities and frame intervals (`cconv.tasks.inputs.Units`).
    `relative_smoothing_length` is the kernel's h in particle spacings. `particle_spacing` and `frame_dt` are those of
    the training data, for the record. `history` is the number of frames that an answer depends on. `features` names the
    features of the task that are inputs of the model.
    `predictor` is the model whose step the network corrects, if there is one.
    `wall_scalars` and `wall_vectors` are the numbers of features of a wall point, 0 without a convolution of the walls.
    `wall_types` are the types of the training data's wall particles, values of `ParticleType`, for a step task.
    `relaxation` is what rollouts of a step apply after every frame. `force_travel` is that of a step task to which the
    integrator adds the external force, in particle spacings. `precision` is that of the network's matrix products.
    """

    task: str
    kernel: str
    relative_smoothing_length: Length
    dim: Whole = Field(ge=1, le=3)
    particle_spacing: Length
    frame_dt: Length | None = None
    history: Whole = 1
    features: tuple[str, ...] = Field(max_length=100)
    wall_scalars: Whole = Field(ge=0, le=1)
    wall_vectors: Whole = Field(ge=0, le=1)
    wall_types: tuple[Whole, ...] = Field((), max_length=100)
    network: NetworkTable
    predictor: "ModelConfig | None" = None
    relaxation: Relaxation | None = None
    force_travel: Annotated[Real, Field(ge=0, le=1e6)] | None = None
    precision: Precision = FLOAT32

    @model_validator(mode="after")
    def _names_are_known(self) -> "ModelConfig":
        for what, name, known in (("task", self.task, TASKS), ("kernel", self.kernel, KERNELS)):
            if name not in known:
                raise ValueError(f"`{what}` must be one of {', '.join(known)}, got {shown(name)}")
        TASKS[self.task].check_features(self.features)
        TASKS[self.task].check_history(self.history)
        if (self.wall_scalars or self.wall_vectors) and WALLS not in self.features:
            raise ValueError(f"a convolution of the walls needs the feature {WALLS!r}")
        if self.wall_scalars and self.wall_vectors:
            raise ValueError("wall points carry a scalar or a vector, not both")
        for name in ("relaxation", "force_travel"):
            if getattr(self, name) is not None and not issubclass(TASKS[self.task], StepTask):
                raise ValueError(f"`{name}` is for steps, and {self.task!r} is a field of one frame")
        return self

    @model_validator(mode="after")
    def _predictor_fits(self) -> "ModelConfig":
        if self.predictor is None:
            return self
        if self.predictor.predictor is not None:
            raise ValueError("a predictor must not have a predictor itself")
        if self.predictor.dim != self.dim:
            raise ValueError(f"the predictor is for {self.predictor.dim} dimensions, the network for {self.dim}")
        as_step(self.asked).check_predictor(self.predictor.asked)
        return self

    @property
    def asked(self) -> Task:
        """Task of the model."""
        return task_named(self.task, self.kernel, self.relative_smoothing_length, self.history, self.force_travel)

    @property
    def fluid_features(self) -> tuple[str, ...]:
        """Names of the input features of a fluid particle."""
        return tuple(name for name in self.features if name != WALLS)

    @property
    def inputs(self) -> Kinds:
        """Numbers of input features of a fluid particle."""
        return self.asked.kinds(self.fluid_features)

    @property
    def walls(self) -> Kinds | None:
        """Numbers of input features of a wall point; None without a convolution of the walls."""
        kinds = Kinds(self.wall_scalars, self.wall_vectors)
        return kinds if any(kinds) else None

    @property
    def output(self) -> Kinds:
        """Numbers of predicted scalars and vectors."""
        return TASKS[self.task].output


@dataclass(frozen=True)
class FrameGeometry:
    """Geometry of one frame, or of several in one graph, shared by all layers.

    Attributes:
        fluid: Fluid particles seen from fluid particles.
        walls: Wall points seen from fluid particles, or None.
    """

    fluid: Geometry
    walls: Geometry | None

    @property
    def nbytes(self) -> int:
        """Memory that the geometry takes at most, in bytes."""
        return self.fluid.nbytes + (0 if self.walls is None else self.walls.nbytes)


def join_geometries(parts: Sequence[FrameGeometry]) -> FrameGeometry:
    """Geometry of several frames, at least one, in one graph; all have walls or none."""
    if len(parts) == 1:
        return parts[0]
    walls = [part.walls for part in parts if part.walls is not None]
    return FrameGeometry(_joined([part.fluid for part in parts]), _joined(walls) if walls else None)


def _joined(parts: Sequence[Any]) -> Geometry:
    """Geometries of one class in one graph."""
    first, *others = parts
    return first.joined_with(others)


class Model(nn.Module):
    """A model that predicts the target of a task at the fluid particles of a frame.

    Args:
        config: Configuration of the model; if it has a predictor, that of the model has no weights yet.
        features: Standardisation of the fluid features that the model takes, from the training split.
        targets: Standardisation of the target, from the training split.
        generator: Source of the initial weights; None for torch's global one.
    """

    feature_mean: Float[Tensor, " C_in"]
    feature_scale: Float[Tensor, " C_in"]
    target_mean: Float[Tensor, " C"]
    target_scale: Float[Tensor, " C"]

    def __init__(
        self,
        config: ModelConfig,
        features: Standardization,
        targets: Standardization,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.config = config
        self.predictor = None if config.predictor is None else untrained(config.predictor).requires_grad_(False)
        self.task = config.asked if self.predictor is None else as_step(config.asked).correcting(self.predictor)
        self.settings: NetworkSettings = config.network
        self.network: Network[Any] = config.network.build(
            config.inputs, config.walls, config.output, config.dim, generator
        )
        for name, values in (("feature", features), ("target", targets)):
            self.register_buffer(f"{name}_mean", values.mean.float())
            self.register_buffer(f"{name}_scale", values.scale.float())

    def relaxed_by(self, relaxation: Relaxation | None) -> "Model":
        """The same model, which shares its weights, with another relaxation of its rollouts.

        Raises:
            ConfigError: If the model is of a field.
        """
        settings = self.config.model_dump() | {"relaxation": relaxation}
        model = copy(self)
        model.config = validated(ModelConfig, settings, "relaxation")
        return model

    @property
    def device(self) -> torch.device:
        """Where the network computes."""
        return self.target_mean.device

    @property
    def home(self) -> torch.device:
        """Where the states of particles best stand: where the network computes, or the CPU if it needs float64."""
        return home_of(self.device)

    @property
    def num_parameters(self) -> int:
        """Number of learned values."""
        return sum(parameter.numel() for parameter in self.parameters())

    @property
    def cutoff(self) -> float:
        """Largest distance that the network searches, at the training data's particle spacing, in their units."""
        return self.settings.relative_cutoff * self.config.particle_spacing

    @property
    def kernel(self) -> AbstractKernel:
        """SPH kernel of the task at the training data's particle spacing."""
        return self.kernel_at(self.config.particle_spacing)

    def kernel_at(self, particle_spacing: float) -> AbstractKernel:
        """SPH kernel of the task in data of any particle spacing."""
        return self.task.kernel_at(particle_spacing, self.config.dim)

    def geometry(self, inputs: Inputs) -> FrameGeometry:
        """Compute the neighbours of a frame, or of each of several, and the geometry that the network reads.

        Raises:
            ShapeError: If the frame has another dimension or other walls than the model.
        """
        self._check(inputs)
        inputs = inputs.read_on(self.device)
        cutoff = self.settings.relative_cutoff
        points, index = inputs.positions, inputs.batch_index
        searches = [
            partial(
                radius_graph,
                points,
                cutoff,
                inputs.box,
                include_self=self.settings.includes_self,
                batch_index=index,
            )
        ]
        if self.config.walls and inputs.wall_positions is not None:
            searches.append(
                partial(
                    radius_graph,
                    inputs.wall_positions,
                    cutoff,
                    inputs.box,
                    queries=points,
                    batch_index=inputs.wall_batch_index,
                    query_batch_index=index,
                )
            )
        fluid, *walls = map(self.settings.geometry, results_of(searches))
        return FrameGeometry(fluid, walls[0] if walls else None)

    def forward(self, inputs: Inputs, geometry: FrameGeometry) -> Float[Tensor, "M C"]:
        """Standardised prediction (M, C) for the particles that are asked about."""
        inputs = inputs.read_on(self.device)
        with products_in(self.config.precision, self.device):
            values = self.network(*self.network_inputs(inputs, geometry)).to(self.target_mean.dtype)
        return values if inputs.answered is None else values[inputs.answered]

    def network_inputs(
        self, inputs: Inputs, geometry: FrameGeometry
    ) -> tuple[Float[Tensor, "N C_in"], Geometry, WallInputs[Geometry] | None]:
        """Return the inputs of the network: standardised features and geometry of the fluid and of the walls."""
        arranged = self.standardized(inputs.features.select(self.config.fluid_features).flat())
        if geometry.walls is None or inputs.wall_features is None:
            return arranged, geometry.fluid, None
        return arranged, geometry.fluid, WallInputs(inputs.wall_features.flat(), geometry.walls)

    def standardized(self, flat: Float[Tensor, "N C"]) -> Float[Tensor, "N C_in"]:
        """Features (N, C), in the order of `Features.flat`, standardised and as the network takes them."""
        features = (flat - self.feature_mean) / self.feature_scale
        return self.settings.arrange(features, self.config.inputs, self.config.dim)

    def standardize_target(self, target: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """Target (N, C) in a sample's units to standardised values."""
        return (target.to(self.device) - self.target_mean) / self.target_scale

    @torch.no_grad()
    def predict(self, inputs: Inputs) -> Float[Tensor, "{inputs.num_answers} C"]:
        """Prediction (M, C) in the units of the data that the inputs were made of."""
        return self._answer(inputs)

    def in_units_of_data(self, prediction: Float[Tensor, "M C"], inputs: Inputs) -> Float[Tensor, "M C"]:
        """Convert a standardised prediction (M, C) to the units of the data, and add what a predictor has answered."""
        standing = (prediction * self.target_scale + self.target_mean).to(inputs.positions.device)
        answer = standing * self.task.unit(inputs.units)
        return answer if inputs.known is None else answer + inputs.known

    @torch.no_grad()
    def predict_frame(self, frame: Frame | Window, scene: Scene) -> Float[Tensor, "M C"]:
        """Prediction (M, C) at the fluid particles of a frame of a data set, in the units of the data, where that is.

        Args:
            frame: A frame for a model of a field, a window up to the present frame for a model of a step.
            scene: Its scene.
        """
        return self.answer(frame, scene)

    def answer(self, observed: Frame | Window, scene: Scene) -> Float[Tensor, "M C"]:
        """`predict_frame`, differentiable."""
        return self._answer(self.inputs(observed.to(self.home), scene)).to(observed.device)

    def _answer(self, inputs: Inputs) -> Float[Tensor, "M C"]:
        return self.in_units_of_data(self(inputs, self.geometry(inputs)), inputs)

    def inputs(self, frame: Frame | Window, scene: Scene) -> Inputs:
        """Compute the inputs of a frame or window, only the features that the model takes.

        Raises:
            ShapeError: If a window lacks walls that the training data had.
        """
        if isinstance(frame, Window):
            self._check_walls(frame)
        return self.task.inputs(frame, scene, self.config.features)

    def _check_walls(self, window: Window) -> None:
        absent = [kind for kind in self.config.wall_types if not (window.particle_types == kind).any()]
        if absent:
            names = " and ".join(str(ParticleType(kind).name).lower().replace("_", " ") for kind in absent)
            raise ShapeError(
                f"The model was trained beside particles of type {names} ({', '.join(map(str, absent))}), and "
                "the data have none; add them to the files, or use a checkpoint of a scene without them."
            )

    def _check(self, inputs: Inputs) -> None:
        if inputs.dim != self.config.dim:
            raise ShapeError(
                f"The model is for {self.config.dim} dimensions, the data have {inputs.dim}; "
                "use a checkpoint that was trained on such a scene."
            )
        if WALLS in self.config.features and inputs.wall_kinds != self.config.walls:
            expected, found = (_in_words(kinds) for kinds in (self.config.walls, inputs.wall_kinds))
            raise ShapeError(
                f"The model expects {expected} at the boundary points, the data have {found}; "
                "use a checkpoint that was trained on such a scene."
            )


def _in_words(walls: Kinds | None) -> str:
    return "none" if walls is None else "normals" if walls.vectors else "no normals"


def build_model(
    network: NetworkSettings,
    task: Task,
    features: Collection[str],
    scene: Scene,
    train_samples: Sequence[Sample],
    generator: torch.Generator | None = None,
    precision: Precision = FLOAT32,
) -> Model:
    """A fresh model for a scene, standardised by its training samples only.

    Args:
        network: Settings of the network.
        task: Task of the model; a predictor of the task becomes part of the model, with its weights.
        features: Names of the features of the task that are inputs; the constant is always one of them.
        scene: Scene of the samples.
        train_samples: Training split.
        generator: Source of the initial weights; None for torch's global one.
        precision: That of the network's matrix products: "float32", "tf32" or "bfloat16".

    Raises:
        ConfigError: If the network would be too large, or a feature is unknown or missing.
    """
    given = train_samples[0].inputs
    walls = (given.wall_kinds if WALLS in features else None) or Kinds(0, 0)
    names = {CONSTANT, *features}
    task.check_features(names)
    predictor = cast("Model | None", task.predictor) if isinstance(task, StepTask) else None
    config = ModelConfig(
        task=task.name,
        kernel=task.kernel,
        relative_smoothing_length=task.relative_smoothing_length,
        dim=scene.dim,
        particle_spacing=scene.particle_spacing,
        frame_dt=scene.frame_dt,
        history=task.history,
        force_travel=task.force_travel if isinstance(task, StepTask) else None,
        features=tuple(name for name in task.features if name in names),
        wall_scalars=walls.scalars,
        wall_vectors=walls.vectors,
        wall_types=_wall_types(train_samples[0]),
        network=network,
        predictor=None if predictor is None else predictor.config,
        precision=precision,
    )
    # Shifted vectors would break the rotation equivariance of the network.
    turns = network.is_equivariant
    taken = (sample.inputs.features.select(config.fluid_features) for sample in train_samples)
    center = network.has_intercept(config.output) and not (turns and config.output.vectors)
    targets = standardize_values((sample.target for sample in train_samples), center)
    standardization = standardize_features(taken, center_vectors=not turns)
    without_weights(config)
    model = Model(config, standardization, targets, generator)
    if predictor is not None and model.predictor is not None:
        model.predictor.load_state_dict(predictor.state_dict())
    return model


def _wall_types(sample: Sample) -> tuple[int, ...]:
    """Types of the particles of a step that are not fluid, ascending."""
    types = set(sample.window.particle_types.tolist()) if isinstance(sample, StepSample) else set()
    return tuple(sorted(types - {ParticleType.FLUID}))


def absent_features(task: Task, names: Collection[str], samples: Sequence[Sample]) -> set[str]:
    """Optional features that tell nothing: one number, or zero vectors, for all particles of all samples.

    So are a force in a scene without one, and distances to walls in a scene without any.
    """
    unseen = {name for name in names if name in task.optional and name != WALLS}
    usual = None
    for sample in samples:
        if not unseen:
            break
        features = sample.inputs.features
        if usual is None:
            usual = torch.cat([features.scalars[0], torch.zeros_like(features.vectors[0].flatten())])
        flat = (features.flat() != usual).any(dim=0)
        unseen -= {name for name, seen in zip(features.columns, flat.tolist(), strict=True) if seen}
    return unseen


def untrained(config: ModelConfig) -> Model:
    """A model that knows no data yet."""
    return Model(config, unknown(config.inputs, config.dim), unknown(config.output, config.dim))


def without_weights(config: ModelConfig) -> Model:
    """Build a model without weights, which takes no memory, to see its size.

    Raises:
        ConfigError: If it would have more than `MOST_PARAMETERS` learned values.
    """
    with torch.device("meta"):
        hollow = untrained(config)
    if hollow.num_parameters > MOST_PARAMETERS:
        raise ConfigError(
            f"the network would have {hollow.num_parameters:,} learned values, more than {MOST_PARAMETERS:,}; lower "
            "`kernel_size`, `radial_terms`, `first_channels`, `hidden_channels` or `layers`."
        )
    return hollow
