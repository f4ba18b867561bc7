r"""Explanation of what a model has learned: its field, the distribution of its errors, and its filters beside ∇W.

The filters of the first layer are measured: pairs of particles lie far apart from all others, one feature of the
sending particle is raised by one unit, and the output at the receiving particle is the filter at
:math:`d = x_j - x_i`. The same pairs probe the analytic operators, whose filters are :math:`m \nabla W(d)` for the
density rate (D2) and :math:`-m \nabla W(d) / \rho_i` for the density gradient (D3). So interpolation, windows, maps and
radial terms act exactly as in a prediction.
"""

import math
from collections.abc import Collection, Iterable
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
import torch
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.models.model import Model
from cconv.neighbors import radius_graph
from cconv.networks.network import ConvolutionNetwork, ConvolutionSettings
from cconv.nn.filters import window_values
from cconv.nn.kinds import split_kinds
from cconv.sph.operators import density
from cconv.tasks.features import DENSITY, VELOCITY, FluidState
from cconv.tasks.inputs import Features, Inputs
from cconv.tasks.samples import Sample
from cconv.tasks.task import as_field

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 0.999, 1.0)
_POINTS_ON_LINE, _RADII, _BINS_PER_DECADE = 161, 80, 5


@torch.no_grad()
def explain(model: Model, sample: Sample) -> dict[str, np.ndarray]:
    """Compute fields and first-layer filters of a model on one frame, as arrays for `np.savez`.

    Args:
        model: The model.
        sample: A frame that the model was not trained on. Filters are scaled by its mass and mean density.

    Returns:
        "particle_spacing"; "positions" (N, D), "target" and "prediction" (N, C), in the units of the data;
        "error" (N,), squared error ÷ variance of the target over training; and the arrays of `first_layer_filters`, if
        the network is one of convolutions.
    """
    is_convolutional = isinstance(model.network, ConvolutionNetwork)
    spacing = sample.inputs.units.length
    return {
        "particle_spacing": np.array(spacing),
        "positions": (sample.inputs.positions * spacing).numpy(),
        "target": (sample.target * sample.target_unit).numpy(),
        "prediction": model.predict(sample.inputs).numpy(),
        "error": _relative_errors(model, sample).square().numpy(),
        **(first_layer_filters(model, sample) if is_convolutional else {}),
    }


@torch.no_grad()
def error_distribution(model: Model, samples: Iterable[Sample]) -> dict[str, np.ndarray]:
    """Compute the distribution of the errors of single particles.

    An error is the root mean square over the components of prediction - target, divided by the standard deviation of
    the target over training.

    Returns:
        "error_bins" (B + 1,), logarithmic; "error_counts" (B,), particles in each, where the first and last bin include
        all beyond; "error_levels", and "error_quantiles" at these levels.
    """
    errors = torch.cat([_relative_errors(model, sample) for sample in samples]).numpy()
    bins = np.logspace(-8, 3, 11 * _BINS_PER_DECADE + 1)
    finite = np.nan_to_num(errors, nan=np.inf, posinf=np.inf)
    counts, _ = np.histogram(finite.clip(bins[0], bins[-1]), bins)
    return {
        "error_bins": bins,
        "error_counts": counts,
        "error_levels": np.array(QUANTILES),
        "error_quantiles": np.quantile(finite, QUANTILES, method="lower"),
    }


@torch.no_grad()
def first_layer_filters(model: Model, sample: Sample) -> dict[str, np.ndarray]:
    """Measure the filters of the first fluid convolution and the analytic ones, for a network of convolutions.

    The filters of a single-layer network are compared directly. The first outputs of a deeper one have no meaning of
    their own, so its filters are combined linearly to be closest to the analytic ones, by least squares over the ball.

    Returns:
        "feature_names" (F,); "is_combined", whether the network has several layers; "unexplained", the squared
        difference by the squared analytic filter over the ball, in the features that the analytic operator reads;
        "cutoff" and "support", the radii of the filters and of W; "line" (L,), offsets through the centre;
        "learned_on_axes" and "analytic_on_axes" (D, L, F, C), filters of each feature and component along each axis;
        "radii" (K,), "learned_radial" (K,), "learned_radial_low" and "learned_radial_high" (K,), the part along d/r
        averaged over directions, and the range of nine of ten directions; "analytic_radial" (K,).
    """
    pairs = _probing_pairs(model)
    analytic = _analytic_filters(model, sample, pairs)
    learned = _learned_filters(model, sample, pairs)
    learned = learned @ _combination(learned[pairs.ball], analytic[pairs.ball], pairs.volume, model)
    unexplained = _unexplained(learned[pairs.ball], analytic[pairs.ball], pairs.volume)
    per_feature = _filter_units(sample)
    learned, analytic = learned * per_feature, analytic * per_feature
    read = _read_names(analytic, sample.inputs.features)
    profile = _along_direction(learned, pairs, sample.inputs.features, read)
    length = sample.inputs.units.length
    results = {
        "is_combined": torch.tensor(_has_several_layers(model)),
        "unexplained": unexplained,
        "cutoff": torch.tensor(length * model.settings.relative_cutoff),
        "support": torch.tensor(length * model.kernel_at(1.0).support_radius),
        "line": length * pairs.line,
        "learned_on_axes": _on_axes(learned, pairs),
        "analytic_on_axes": _on_axes(analytic, pairs),
        "radii": length * pairs.radii,
        "learned_radial": profile.mean(dim=1),
        "learned_radial_low": profile.quantile(0.05, dim=1),
        "learned_radial_high": profile.quantile(0.95, dim=1),
        "analytic_radial": _along_direction(analytic, pairs, sample.inputs.features, read)[:, 0],
    }
    return {"feature_names": np.array(_component_names(sample.inputs.features))} | {
        name: values.numpy() for name, values in results.items()
    }


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Displacements d = x_j - x_i at which filters are probed, in particle spacings: along each axis, then over a ball.

    Attributes:
        displacements: (P, D).
        ball: Mask of those that belong to the ball, (P,).
        line: Offsets along an axis, (L,).
        radii: Distances in the ball, (K,); each has the same directions.
        volume: Weight of each point of the ball, the volume that it represents.
        spacing: Distance between two pairs, larger than the radii of filters and W.
    """

    displacements: Tensor
    ball: Tensor
    line: Tensor
    radii: Tensor
    volume: Tensor
    spacing: float

    @property
    def positions(self) -> Tensor:
        """Receivers (P, D), then senders (P, D), each pair apart from all others."""
        receivers = torch.zeros_like(self.displacements)
        receivers[:, 0] = self.spacing * torch.arange(len(receivers))
        return torch.cat([receivers, receivers + self.displacements])


def _probing_pairs(model: Model) -> _Pairs:
    dim = model.config.dim
    reach = max(model.settings.relative_cutoff, model.kernel_at(1.0).support_radius)
    line = torch.linspace(-reach, reach, _POINTS_ON_LINE, dtype=torch.float64)
    on_axes = torch.cat([line[:, None] * axis for axis in torch.eye(dim, dtype=torch.float64)])
    radii = reach * (torch.arange(_RADII, dtype=torch.float64) + 0.5) / _RADII
    directions = _directions(dim)
    in_ball = (radii[:, None, None] * directions).flatten(0, 1)
    return _Pairs(
        displacements=torch.cat([on_axes, in_ball]),
        ball=torch.arange(len(on_axes) + len(in_ball)) >= len(on_axes),
        line=line,
        radii=radii,
        volume=(radii ** (dim - 1)).repeat_interleave(len(directions)),
        spacing=4 * reach,
    )


def _directions(dim: int) -> Tensor:
    """Evenly spread unit vectors (M, D): both of a line, 48 of a circle, 96 of a sphere (a golden spiral)."""
    if dim == 1:
        return torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    if dim == 2:
        angles = 2 * math.pi * (torch.arange(48, dtype=torch.float64) + 0.5) / 48
        return torch.stack([angles.cos(), angles.sin()], dim=1)
    turns = torch.arange(96, dtype=torch.float64)
    height, angles = 1 - (2 * turns + 1) / 96, math.pi * (3 - math.sqrt(5)) * turns
    width = (1 - height.square()).sqrt()
    return torch.stack([width * angles.cos(), width * angles.sin(), height], dim=1)


def _learned_filters(model: Model, sample: Sample, pairs: _Pairs) -> Tensor:
    """Measure the outputs of the first convolution per unit of each feature (P, F, C_out), without bias."""
    twin, given = deepcopy(model).double(), sample.inputs
    (network, _), (_, settings) = _convolutions(twin), _convolutions(model)
    twin.settings = settings.model_copy(update={"normalize": False})
    rest = given.features.flat().double().mean(dim=0).expand(2 * len(pairs.displacements), -1)
    isolated = _isolated_inputs(pairs, rest, given)
    geometry = twin.geometry(isolated)

    def answer(features: Tensor) -> Tensor:
        values = twin.network_inputs(_isolated_inputs(pairs, features, given), geometry)[0]
        return network.convs[0](values, geometry.fluid)[: len(pairs.displacements)]

    answers = [answer(raised) - answer(rest) for raised in _raised(rest)]
    return torch.stack(answers, dim=1) / (_mean_window_sum(settings, sample) if settings.normalize else 1)


def _analytic_filters(model: Model, sample: Sample, pairs: _Pairs) -> Tensor:
    """Measure the outputs of the analytic operator per unit of each feature (P, F, C), for mean density and mass."""
    inputs, kernel = sample.inputs.double(), model.kernel_at(1.0)
    densities = inputs.features.named(DENSITY)
    edges = radius_graph(inputs.positions, kernel.support_radius, inputs.box)
    mass = (densities / density(torch.ones_like(densities), edges, kernel)).mean()
    names = inputs.features.scalar_names
    rest = torch.zeros(2 * len(pairs.displacements), inputs.features.flat().shape[1], dtype=torch.float64)
    rest[:, names.index(DENSITY)] = densities.mean()
    edges = radius_graph(pairs.positions, kernel.support_radius)

    def answer(flat: Tensor) -> Tensor:
        features = inputs.features.with_values(flat)
        state = FluidState(
            positions=pairs.positions,
            velocities=features.named(VELOCITY),
            masses=mass.expand(len(flat)),
            box=None,
            kernel=kernel,
        )
        answers = as_field(model.task).field(state.knowing(edges, features.named(DENSITY)))
        return answers[: len(pairs.displacements)]

    return torch.stack([answer(raised) for raised in _raised(rest)], dim=1)


def _component_names(features: Features) -> list[str]:
    """Symbols of the scalars and of the components of the vectors, as `Features.flat` orders them."""
    symbols = {DENSITY: "ρ", VELOCITY: "v"}
    axes = "xyz"[: features.vectors.shape[2]]
    scalars = [symbols.get(name, "1") for name in features.scalar_names]
    return scalars + [f"{symbols[name]}_{axis}" for name in features.vector_names for axis in axes]


def _raised(rest: Tensor) -> list[Tensor]:
    """Features (2P, F) with one feature of the senders raised by one, for each feature."""
    senders = torch.arange(len(rest)) >= len(rest) // 2
    units = torch.eye(rest.shape[1], dtype=rest.dtype)
    return [rest + senders[:, None] * unit for unit in units]


def _filter_units(sample: Sample) -> Tensor:
    """Return the unit of the filters of each feature, in the units of the data, (F, 1)."""
    units, features = sample.inputs.units, sample.inputs.features
    of_name = {DENSITY: units.density, VELOCITY: units.velocity}
    per_column = [of_name.get(name, 1.0) for name in features.columns]
    return (sample.target_unit / torch.tensor(per_column).double())[:, None]


def _isolated_inputs(pairs: _Pairs, flat: Tensor, like: Inputs) -> Inputs:
    """Return the pairs as inputs with features (2P, F), without any wall points."""
    walls = like.wall_features
    none = None if walls is None else replace(walls, scalars=walls.scalars[:0], vectors=walls.vectors[:0])
    return Inputs(
        positions=pairs.positions,
        features=like.features.with_values(flat),
        wall_positions=None if none is None else pairs.positions[:0],
        wall_features=None if none is None else none.to(torch.float64),
        box=Box([0.0] * like.dim, [1.0] * like.dim),
        units=like.units,
    )


def _convolutions(model: Model) -> tuple[ConvolutionNetwork, ConvolutionSettings]:
    """Return the network and its settings, of a model whose filters are measured."""
    network, settings = model.network, model.settings
    if not (isinstance(network, ConvolutionNetwork) and isinstance(settings, ConvolutionSettings)):
        raise ConfigError(f"`architecture` must be one of convolutions to have filters, got {settings.architecture!r}.")
    return network, settings


def _has_several_layers(model: Model) -> bool:
    return len(_convolutions(model)[0].convs) > 1


def _mean_window_sum(settings: ConvolutionSettings, sample: Sample) -> Tensor:
    """Average ψ, the divisor of normalised filters, over the particles."""
    edges = radius_graph(sample.inputs.positions.double(), settings.relative_cutoff, sample.inputs.box)
    values = window_values((edges.distances / edges.cutoff) ** 2, settings.window)
    return values.sum() / edges.num_receivers


def _combination(learned: Tensor, analytic: Tensor, volume: Tensor, model: Model) -> Tensor:
    """Weights (C_out, C) of the layer's outputs: the target's units, or the nearest to the analytic filters."""
    if not _has_several_layers(model):
        return torch.diag(model.target_scale.double())
    read, root = _read_features(analytic), volume.sqrt()[:, None, None]
    terms, wanted = ((root * values[:, read]).flatten(0, 1) for values in (learned, analytic))
    return torch.linalg.lstsq(terms, wanted, driver="gelsd").solution


def _unexplained(learned: Tensor, analytic: Tensor, volume: Tensor) -> Tensor:
    read, weights = _read_features(analytic), volume[:, None, None]
    difference, size = ((weights * values[:, read].square()).sum() for values in (learned - analytic, analytic))
    return difference / size


def _read_features(analytic: Tensor) -> Tensor:
    """Return a mask of the features that the analytic operator reads, (F,)."""
    return analytic.abs().amax(dim=(0, 2)) > 0


def _read_names(analytic: Tensor, features: Features) -> set[str]:
    """Names of the features that the analytic operator reads."""
    return set(compress(features.columns, _read_features(analytic).tolist()))


def _on_axes(filters: Tensor, pairs: _Pairs) -> Tensor:
    """Filters along each axis, (D, L, F, C)."""
    return filters[~pairs.ball].unflatten(0, (-1, len(pairs.line)))


def _along_direction(filters: Tensor, pairs: _Pairs, features: Features, read: Collection[str]) -> Tensor:
    """Return the part along d/r of filters (P, F, C) by distance (K, M), for the density if read, else velocities."""
    displacements = pairs.displacements[pairs.ball]
    directions = displacements / displacements.norm(dim=1, keepdim=True)
    answers = filters[pairs.ball]
    if DENSITY in read:
        vectors = answers[:, features.scalar_names.index(DENSITY)]
    else:
        vectors = split_kinds(answers[:, :, 0], features.kinds, directions.shape[1])[1][:, 0]
    return (vectors * directions).sum(dim=1).unflatten(0, (len(pairs.radii), -1))


def _relative_errors(model: Model, sample: Sample) -> Tensor:
    """Return the root mean square error of each particle ÷ standard deviation of the target, (N,)."""
    prediction = model(sample.inputs, model.geometry(sample.inputs))
    return (prediction - model.standardize_target(sample.target)).double().square().mean(dim=1).sqrt()
