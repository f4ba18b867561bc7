"""A network together with what it needs to predict a physical field: cutoff, scaling and the target's definition."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn

from cconv.data.features import (
    Inputs,
    Standardization,
    fluid_state,
    inputs_without_density,
    make_inputs,
    standardize_features,
)
from cconv.data.features import standardize_vectors as standardize_targets
from cconv.data.targets import VECTOR_TASKS, Sample, target_channels, target_unit
from cconv.data.trajectory import Frame, Scene
from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import Edges, radius_graph
from cconv.networks import ConvNet, RadialNet
from cconv.nn import ConvGeometry, RadialGeometry
from cconv.ops.workers import results_of
from cconv.sph.kernels import KERNELS, kernel_named
from cconv.validation import Flag, Length, Real, Whole

MOST_PARAMETERS = 10**8  # with Adam's moments 1.6 GB


class NetworkConfig(BaseModel):
    """Hyperparameters of a network: a ConvNet (`basis` "grid") or a RadialNet ("radial").

    The defaults have the published layer sizes and filters: 692,902 parameters for 4 inputs and 3 outputs in a scene
    with normals. Initial weights are the thesis's, Xavier-uniform; "open3d" draws them as the published code did.
    `relative_cutoff` is the filter radius R in particle spacings (published: diameter 0.225 = 1.5·6·0.025 at spacing
    0.05, so R = 2.25 spacings). The layers have `first_channels`, then `hidden_channels`, and the target's components;
    a RadialNet has so many scalars and as many vectors. `kernel_size`, `mapping`, `interpolation`, `align_corners` and
    `initialization` are the grid's, `radial_terms` is the radial basis's. Without `boundary` a model has no boundary
    branch, even in a scene with walls; without `density` its features are [1, v].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    layers: Whole = Field(4, ge=1, le=16)
    first_channels: Whole = Field(32, ge=1, le=4096)
    hidden_channels: Whole = Field(64, ge=1, le=4096)
    basis: Literal["grid", "radial"] = "grid"
    radial_terms: Whole = Field(16, ge=1, le=512)
    kernel_size: Whole = Field(4, ge=1, le=32)
    relative_cutoff: Real = Field(2.25, ge=1e-3, le=10)
    mapping: Literal["identity", "ball_to_cube_radial", "ball_to_cube_volume_preserving"] = (
        "ball_to_cube_volume_preserving"
    )
    window: Literal["none", "poly6", "gaussian", "cubic_spline"] = "poly6"
    interpolation: Literal["linear", "nearest_neighbor", "linear_border"] = "linear"
    align_corners: Flag = True
    normalize: Flag = False
    message: Literal["absolute", "difference"] = "absolute"
    activation: Literal["relu", "gelu", "tanh", "leaky_relu"] = "relu"
    skip: Literal["before_activation", "after_activation", "none"] = "before_activation"
    initialization: Literal["xavier_uniform", "open3d", "thesis"] = "xavier_uniform"
    boundary: Flag = True
    density: Flag = True

    @model_validator(mode="after")
    def _skip_fits_basis(self) -> "NetworkConfig":
        if self.basis == "radial" and self.skip == "after_activation":
            raise ValueError("skip 'after_activation' is for basis 'grid'; take 'before_activation' or 'none'")
        return self

    @property
    def hidden_widths(self) -> list[int]:
        """Outputs of each layer but the last."""
        return [self.first_channels, *[self.hidden_channels] * (self.layers - 2)] if self.layers > 1 else []


class FieldConfig(BaseModel):
    """Everything that rebuilds a model except its weights; stored as `config.json`.

    The network computes in particle spacings, rest densities and frame intervals (`cconv.data.features.Units`).
    `relative_smoothing_length` is the kernel's h in particle spacings. `particle_spacing` is that of the training data,
    for the record. `boundary_channels` is 0 for a model without a boundary branch.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    task: Literal["density_rate", "density_gradient"]
    dim: Whole = Field(ge=1, le=3)
    particle_spacing: Length
    kernel: Literal[tuple(KERNELS)]
    relative_smoothing_length: Length
    boundary_channels: Whole = Field(ge=0, le=3)
    network: NetworkConfig

    @property
    def feature_channels(self) -> int:
        """Features of a fluid particle: [1, v, ρ] or [1, v]."""
        return self.dim + 1 + self.network.density

    @property
    def takes_differences(self) -> bool:
        """Whether fluid convolutions take differences of features, to which the constant adds nothing."""
        return self.network.message == "difference"

    @property
    def has_intercept(self) -> bool:
        """Whether there is something that does not follow from the features: biases, and a shift of the target.

        A density rate from differences has none, so that it is 0 where nothing differs.
        """
        return not (self.takes_differences and self.task not in VECTOR_TASKS)


@dataclass(frozen=True)
class FieldGeometry:
    """Geometry of one frame, shared by all layers.

    Attributes:
        fluid: Fluid particles seen from fluid particles.
        boundary: Boundary points seen from fluid particles, or None.
    """

    fluid: ConvGeometry | RadialGeometry
    boundary: ConvGeometry | RadialGeometry | None

    @property
    def nbytes(self) -> int:
        """Memory that the geometry takes at most, in bytes."""
        return self.fluid.nbytes + (0 if self.boundary is None else self.boundary.nbytes)


class FieldModel(nn.Module):
    """Predicts an SPH field at the fluid particles of a frame.

    Args:
        config: What to build.
        features: Standardisation of the fluid features that the model takes, from the training split.
        targets: Standardisation of the target, from the training split.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(
        self,
        config: FieldConfig,
        features: Standardization,
        targets: Standardization,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.config = config
        self.network = _NETWORKS[config.network.basis](config, generator)
        for name, values in (("feature", features), ("target", targets)):
            self.register_buffer(f"{name}_mean", values.mean.float())
            self.register_buffer(f"{name}_scale", values.scale.float())

    @property
    def num_parameters(self) -> int:
        """Number of learned values."""
        return sum(parameter.numel() for parameter in self.parameters())

    @property
    def cutoff(self) -> float:
        """Filter radius R at the training data's particle spacing, in their units."""
        return self.config.network.relative_cutoff * self.config.particle_spacing

    @property
    def kernel(self):
        """SPH kernel of the density feature and the target, at the training data's particle spacing."""
        return self.kernel_at(self.config.particle_spacing)

    def kernel_at(self, particle_spacing: float):
        """SPH kernel of the density feature and the target in data of any particle spacing."""
        smoothing_length = self.config.relative_smoothing_length * particle_spacing
        return kernel_named(self.config.kernel)(smoothing_length, self.config.dim)

    def geometry(self, inputs: Inputs) -> FieldGeometry:
        """Neighbours and filter positions of a frame.

        Raises:
            ShapeError: If the frame has another dimension or other boundary features than the model.
        """
        self._check(inputs)
        cutoff = self.config.network.relative_cutoff
        searches = [partial(radius_graph, inputs.positions, cutoff, inputs.box)]
        if self.config.boundary_channels:
            walls = inputs.boundary_positions
            searches.append(partial(radius_graph, walls, cutoff, inputs.box, queries=inputs.positions))
        fluid, *boundary = map(self._conv_geometry, results_of(searches))
        return FieldGeometry(fluid, boundary[0] if boundary else None)

    def forward(self, inputs: Inputs, geometry: FieldGeometry) -> Tensor:
        """Standardised field (N, C)."""
        return self.network(*self.network_inputs(inputs, geometry))

    def network_inputs(self, inputs: Inputs, geometry: FieldGeometry) -> tuple:
        """What the network takes: standardised features and geometry of the fluid, then of the boundary."""
        channels = self.config.feature_channels
        features = (inputs.features[:, :channels] - self.feature_mean) / self.feature_scale
        if self.config.network.basis == "radial":
            one, velocity, rho = features.tensor_split((1, self.config.dim + 1), dim=1)
            features = torch.cat([one, rho, velocity], dim=1)  # scalars come first
        if self.config.takes_differences:
            features = features[:, 1:]
        boundary = (inputs.boundary_features, geometry.boundary) if geometry.boundary is not None else ()
        return features, geometry.fluid, *boundary

    def standardize_target(self, target: Tensor) -> Tensor:
        """Field (N, C) in a sample's units to standardised values."""
        return (target - self.target_mean) / self.target_scale

    @torch.no_grad()
    def predict(self, inputs: Inputs) -> Tensor:
        """Field (N, C) in the units of the data that the inputs were made of."""
        field = self(inputs, self.geometry(inputs)) * self.target_scale + self.target_mean
        return field * target_unit(self.config.task, inputs.units)

    def predict_frame(self, frame: Frame, scene: Scene) -> Tensor:
        """Field (N, C) at the fluid particles of a frame of a data set, in the units of the data."""
        return self.predict(self.inputs(frame, scene))

    def inputs(self, frame: Frame, scene: Scene) -> Inputs:
        """What the model is given of a frame of a data set; densities are only summed for models that take them."""
        if not self.config.network.density:
            return inputs_without_density(frame, scene)
        kernel = self.kernel_at(scene.particle_spacing)
        return make_inputs(fluid_state(frame, scene.box, kernel), frame.boundary, scene)

    def _conv_geometry(self, edges: Edges) -> ConvGeometry | RadialGeometry:
        return _GEOMETRIES[self.config.network.basis](edges, self.config.network)

    def _check(self, inputs: Inputs) -> None:
        if inputs.positions.shape[1] != self.config.dim:
            raise ShapeError(
                f"The model is for {self.config.dim} dimensions, the data have {inputs.positions.shape[1]}; "
                "use a checkpoint that was trained on such a scene."
            )
        if inputs.features.shape[1] < self.config.feature_channels:
            raise ShapeError(
                f"The model expects {self.config.feature_channels} features [1, v, ρ], the inputs have "
                f"{inputs.features.shape[1]}; give it inputs with density."
            )
        channels = _boundary_channels(self.config.network, inputs)
        if channels != self.config.boundary_channels:
            raise ShapeError(
                f"The model expects {self.config.boundary_channels} boundary features, the data have {channels}; "
                "use a checkpoint that was trained on such a scene."
            )


def _boundary_channels(network: NetworkConfig, inputs: Inputs) -> int:
    """Features of a boundary point that a network takes; 0 if it takes none."""
    return 0 if inputs.boundary_features is None or not network.boundary else inputs.boundary_features.shape[1]


def _own_channels(config: FieldConfig) -> tuple[int, int]:
    """Scalars and vectors of a particle itself that the first layer takes, beside its convolution.

    From differences the density rate does not depend on them; of a density gradient, the density is a factor. A bias
    stands for the constant where all that is taken passes a linear map.
    """
    if not config.takes_differences:
        return int(config.network.density), 1
    return int(config.network.density and config.task in VECTOR_TASKS), 0


def _grid_network(config: FieldConfig, generator: torch.Generator | None) -> ConvNet:
    network = config.network
    own_channels = _own_channels(config)[0] if config.takes_differences else None
    return ConvNet(
        config.feature_channels - config.takes_differences,
        (*network.hidden_widths, target_channels(config.task, config.dim)),
        network.kernel_size,
        config.dim,
        boundary_channels=config.boundary_channels,
        activation=network.activation,
        message=network.message,
        skip=network.skip,
        initialization=network.initialization,
        own_channels=own_channels,
        bias=config.has_intercept,
        generator=generator,
    )


def _radial_network(config: FieldConfig, generator: torch.Generator | None) -> RadialNet:
    network = config.network
    is_vector = config.task in VECTOR_TASKS
    has_normals = config.boundary_channels == config.dim
    return RadialNet(
        (1 + network.density - config.takes_differences, 1),
        (*((width, width) for width in network.hidden_widths), (0, 1) if is_vector else (1, 0)),
        network.radial_terms,
        config.dim,
        boundary_channels=(0, 1) if has_normals else (config.boundary_channels, 0),
        activation=network.activation,
        message=network.message,
        residual=network.skip == "before_activation",
        own_channels=_own_channels(config),
        bias=config.has_intercept,
        generator=generator,
    )


def _grid_geometry(edges: Edges, network: NetworkConfig) -> ConvGeometry:
    return ConvGeometry(
        edges,
        network.kernel_size,
        mapping=network.mapping,
        window=network.window,
        interpolation=network.interpolation,
        align_corners=network.align_corners,
        normalize=network.normalize,
    )


def _radial_geometry(edges: Edges, network: NetworkConfig) -> RadialGeometry:
    return RadialGeometry(edges, network.radial_terms, window=network.window, normalize=network.normalize)


_NETWORKS = {"grid": _grid_network, "radial": _radial_network}
_GEOMETRIES = {"grid": _grid_geometry, "radial": _radial_geometry}


def build_field_model(
    network: NetworkConfig,
    scene: Scene,
    task: str,
    kernel_name: str,
    smoothing_length: float,
    train_samples: Sequence[Sample],
    generator: torch.Generator | None = None,
) -> FieldModel:
    """A fresh model for a scene, standardised by its training samples only."""
    config = FieldConfig(
        task=task,
        dim=scene.dim,
        particle_spacing=scene.particle_spacing,
        kernel=kernel_name,
        relative_smoothing_length=smoothing_length / scene.particle_spacing,
        boundary_channels=_boundary_channels(network, train_samples[0].inputs),
        network=network,
    )
    # Shifted vectors would not turn with the scene, as all of a RadialNet does.
    turns = network.basis == "radial"
    features = standardize_features((sample.inputs.features for sample in train_samples), center_velocity=not turns)
    center = config.has_intercept and not (turns and task in VECTOR_TASKS)
    targets = standardize_targets((sample.target for sample in train_samples), center)
    features = features.first(config.feature_channels)
    check_size(config, features, targets)
    return FieldModel(config, features, targets, generator)


def check_size(config: FieldConfig, features: Standardization, targets: Standardization) -> FieldModel:
    """A model without weights, which takes no memory, to see what it would have; arguments as of `FieldModel`.

    Raises:
        ConfigError: If it would have more than `MOST_PARAMETERS` learned values.
    """
    with torch.device("meta"):
        hollow = FieldModel(config, features, targets)
    if hollow.num_parameters > MOST_PARAMETERS:
        raise ConfigError(
            f"the network would have {hollow.num_parameters:,} learned values, more than {MOST_PARAMETERS:,}; lower "
            "`kernel_size`, `radial_terms`, `first_channels`, `hidden_channels` or `layers`."
        )
    return hollow
