"""Networks of a single layer are linear in their coefficients: least squares finds these without training."""

from collections.abc import Sequence

import torch
from torch import Tensor

from cconv.errors import ConfigError
from cconv.networks.conv_net import ConvNet
from cconv.networks.radial_net import RadialNet
from cconv.nn.continuous_conv import MESSAGES, ConvGeometry
from cconv.nn.radial_conv import RadialConv, RadialGeometry, split_kinds
from cconv.ops.convolution import columns


class NormalEquations:
    """Least squares of ``terms @ coefficients ≈ targets``, row by row, in float64.

    Args:
        num_terms: Number of coefficients P of each output.
        num_outputs: Number of outputs C.
    """

    def __init__(self, num_terms: int, num_outputs: int):
        self._products = torch.zeros(num_terms, num_terms, dtype=torch.float64)
        self._projections = torch.zeros(num_terms, num_outputs, dtype=torch.float64)

    def add(self, terms: Tensor, targets: Tensor) -> None:
        """Take in terms (R, P) and targets (R, C)."""
        self._products.addmm_(terms.T, terms)
        self._projections.addmm_(terms.T, targets)

    def solve(self, ridge: float) -> Tensor:
        """Coefficients (P, C) that minimise the mean squared error + ``ridge`` · mean square of a term · |c|².

        Raises:
            ConfigError: If the equations cannot be solved, e.g. for dependent terms without ridge.
        """
        size = len(self._products)
        shift = ridge * self._products.diagonal().mean() * torch.eye(size, dtype=torch.float64)
        factor, failed = torch.linalg.cholesky_ex(self._products + shift)
        if failed:
            raise ConfigError(
                f"`ridge` must be larger, got {ridge:g}: the {size} terms depend on each other to rounding; "
                "take 1e-10 or more."
            )
        return torch.cholesky_solve(self._projections, factor)


class GridLayer:
    """The single layer of a `ConvNet` as a linear map of its coefficients."""

    def __init__(self, network: ConvNet):
        self.network = network

    def terms(
        self,
        features: Tensor,
        geometry: ConvGeometry,
        boundary_features: Tensor | None = None,
        boundary_geometry: ConvGeometry | None = None,
    ) -> list[Tensor]:
        """Terms (N, P): columns of the boundary and the fluid, a particle's own features, one; those that there are."""
        own = MESSAGES[self.network.convs[0].message]
        parts = [columns(features, geometry.reads, own), self.network.own(features)]
        if self._bias is not None:
            parts.append(torch.ones_like(features[:, :1]))
        if boundary_features is not None:
            parts.insert(0, columns(boundary_features, boundary_geometry.reads))
        return [torch.cat(parts, dim=1)]

    def targets(self, target: Tensor) -> list[Tensor]:
        """Targets (N, C) of each set of terms."""
        return [target]

    @torch.no_grad()
    def assign(self, coefficients: Sequence[Tensor]) -> None:
        """Make coefficients (P, C) those of the network."""
        (values,) = coefficients
        convs = [conv for conv in (self.network.boundary_conv, self.network.convs[0]) if conv is not None]
        weights = [conv.filters for conv in convs]
        if self.network.own_dense is not None:
            weights.append(self.network.own_dense.weight.T)
        for bias in (conv.bias for conv in convs if conv.bias is not None):
            bias.zero_()
        _assign([*weights, *([] if self._bias is None else [self._bias[None]])], values)

    @property
    def _bias(self) -> Tensor | None:
        """The bias that is fitted; convolutions with another of their own keep 0."""
        dense = self.network.own_dense
        return None if dense is None else dense.bias


class RadialLayer:
    """The single layer of a `RadialNet` as a linear map of its coefficients: scalars apart from vectors."""

    def __init__(self, network: RadialNet):
        self.network = network

    def terms(
        self,
        features: Tensor,
        geometry: RadialGeometry,
        boundary_features: Tensor | None = None,
        boundary_geometry: RadialGeometry | None = None,
    ) -> list[Tensor]:
        """Terms of the scalars (N, P) and of the components of the vectors (N · D, P'), where there are any."""
        convolved = [(self.network.convs[0], features, geometry)]
        if boundary_features is not None:
            convolved.insert(0, (self.network.boundary_conv, boundary_features, boundary_geometry))
        gathered = [_radial_columns(*inputs) for inputs in convolved]
        scalars, vectors = split_kinds(self.network.own(features), self.network.own_channels, self.network.dim)
        of_scalars = [*(to_scalars for to_scalars, _ in gathered), scalars]
        if self.network.own_dense is not None and self.network.own_dense.bias is not None:
            of_scalars.append(torch.ones_like(features[:, :1]))
        of_vectors = [*(to_vectors for _, to_vectors in gathered), vectors.transpose(1, 2).flatten(0, 1)]
        terms = [torch.cat(of_scalars, dim=1), torch.cat(of_vectors, dim=1)]
        return [values for values, count in zip(terms, self._out_channels, strict=True) if count]

    def targets(self, target: Tensor) -> list[Tensor]:
        """Targets (N, S) and (N · D, V) of each set of terms."""
        scalars, vectors = split_kinds(target, self._out_channels, self.network.dim)
        targets = [scalars, vectors.transpose(1, 2).flatten(0, 1)]
        return [values for values, count in zip(targets, self._out_channels, strict=True) if count]

    @torch.no_grad()
    def assign(self, coefficients: Sequence[Tensor]) -> None:
        """Make coefficients (P, S) and (P', V) those of the network."""
        network, dense = self.network, self.network.own_dense
        convs = [conv for conv in (network.boundary_conv, network.convs[0]) if conv is not None]
        weights = [[conv.scalar_filters for conv in convs], [conv.vector_filters for conv in convs]]
        if dense is not None:
            weights[0] += [dense.scalar_weights, *([] if dense.bias is None else [dense.bias[None]])]
            weights[1] += [dense.vector_weights]
        present = [kind for kind, count in zip(weights, self._out_channels, strict=True) if count]
        for tensors, values in zip(present, coefficients, strict=True):
            _assign(tensors, values)

    @property
    def _out_channels(self) -> tuple[int, int]:
        return self.network.convs[0].out_channels


def linear_layer(network: ConvNet | RadialNet) -> GridLayer | RadialLayer:
    """The single layer of a network as a linear map of its coefficients.

    Raises:
        ConfigError: If the network has several layers.
    """
    if len(network.convs) != 1:
        raise ConfigError(f"`network.layers` must be 1 for a closed form, got {len(network.convs)}; train the others.")
    return GridLayer(network) if isinstance(network, ConvNet) else RadialLayer(network)


def _radial_columns(conv: RadialConv, features: Tensor, geometry: RadialGeometry) -> tuple[Tensor, Tensor]:
    to_scalars, to_vectors = geometry.messages(features, conv.in_channels, conv.message)
    components = [columns(component, geometry.reads) for component in to_vectors]
    return columns(to_scalars, geometry.reads), torch.stack(components, dim=1).flatten(0, 1)


def _assign(weights: Sequence[Tensor], values: Tensor) -> None:
    """Copy rows of `values` (P, C) to weights whose last axis is C, in order."""
    rows = values.split([weight.numel() // values.shape[1] for weight in weights])
    for weight, part in zip(weights, rows, strict=True):
        weight.copy_(part.reshape(weight.shape))
