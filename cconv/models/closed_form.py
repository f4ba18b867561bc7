"""The closed form of a single layer, which is linear in its coefficients, so that least squares finds them."""

from collections.abc import Callable, Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.devices import CPU
from cconv.errors import ConfigError
from cconv.models.model import Model, build_model
from cconv.networks import RadialNetSettings
from cconv.networks.network import NetworkSettings
from cconv.tasks import task_named
from cconv.tasks.inputs import Inputs
from cconv.tasks.samples import FrameSamples, Sample
from cconv.tasks.task import as_field


class NormalEquations:
    """Least squares of ``terms @ coefficients ≈ targets``, row by row, in float64.

    Args:
        num_terms: Number of coefficients P of each output.
        num_outputs: Number of outputs C.
        device: Where they are summed and solved.
    """

    def __init__(self, num_terms: int, num_outputs: int, device: torch.device = CPU):
        self._products = torch.zeros(num_terms, num_terms, dtype=torch.float64, device=device)
        self._projections = torch.zeros(num_terms, num_outputs, dtype=torch.float64, device=device)

    def add(self, terms: Float[Tensor, "R P"], targets: Float[Tensor, "R C"]) -> None:
        """Add terms (R, P) and targets (R, C) to the equations."""
        self._products.addmm_(terms.T, terms)
        self._projections.addmm_(terms.T, targets)

    def solve(self, ridge: float) -> Float[Tensor, "P C"]:
        """Return the coefficients (P, C) that minimise mean squared error + ``ridge`` · mean square of a term · |c|².

        Raises:
            ConfigError: If the equations cannot be solved, e.g. for dependent terms without ridge.
        """
        size = len(self._products)
        shift = ridge * self._products.diagonal().mean() * torch.eye(size).to(self._products)
        factor, failed = torch.linalg.cholesky_ex(self._products + shift)
        if failed:
            raise ConfigError(
                f"`ridge` must be larger, got {ridge:g}: the {size} terms depend on each other to rounding; "
                f"take {max(100 * ridge, 1e-10):g} or more."
            )
        return torch.cholesky_solve(self._projections, factor)


def fit_closed_form(
    dataset: Dataset,
    task: str = "density_rate",
    *,
    network: NetworkSettings | None = None,
    features: Sequence[str] | None = None,
    kernel: str = "cubic_spline",
    smoothing_length: float | None = None,
    ridge: float = 1e-10,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Model:
    """Fit a model of a single layer to the training split of a data set.

    Least squares over all particles of all frames, accumulated frame by frame in float64 normal equations. The model
    saves, loads and evaluates like a trained one.

    Args:
        dataset: Data set.
        task: "density_rate" or "density_gradient".
        network: Settings of the layer: message, cutoff, window, mapping ...; by default 16 radial terms on differences
            to the neighbours within the support of the kernel.
        features: Names of the features of the task that are inputs of the layer; None for all.
        kernel: SPH kernel of the target.
        smoothing_length: Smoothing length h of the kernel; None for the particle spacing.
        ridge: Weight of the squared coefficients, in mean squares of a term.
        progress: Wraps the frames of the last pass, e.g. with a progress bar.

    Raises:
        ConfigError: If the network has several layers, or the terms depend on each other and `ridge` is too small.
    """
    spacing = dataset.scene.particle_spacing
    asked = as_field(task_named(task, kernel, 1.0 if smoothing_length is None else smoothing_length / spacing))
    if network is None:
        reach = asked.kernel_at(1.0, dataset.scene.dim).support_radius
        network = RadialNetSettings(layers=1, message="difference", relative_cutoff=reach)
    samples = FrameSamples(dataset, "train", asked)
    model = build_model(network, asked, asked.features if features is None else features, dataset.scene, samples)
    solve_closed_form(model, samples, ridge, progress)
    return model.eval()


def solve_closed_form(
    model: Model,
    samples: Iterable[Sample],
    ridge: float = 1e-10,
    progress: Callable[[Iterable], Iterable] = iter,
    weight: Callable[[Tensor], float] = lambda target: 1.0,
) -> None:
    """Set the coefficients of a model of a single layer to the least-squares solution on `samples`, in place.

    Args:
        model: Model whose network has one layer.
        samples: Samples to fit.
        ridge: Weight of the squared coefficients, in mean squares of a term.
        progress: Wraps the samples, e.g. with a progress bar.
        weight: How much a frame's squared error counts, by its standardised target.

    Raises:
        ConfigError: If the network has several layers, `ridge` is negative, or the terms depend on each other and
            `ridge` is too small.
    """
    if not ridge >= 0:
        raise ConfigError(f"`ridge` must be at least 0, got {ridge}.")
    layer = model.network.linear_terms()
    equations: list[NormalEquations] = []
    for stored in progress(samples):
        sample = stored.to(model.home)
        inputs = sample.inputs.double()
        terms = layer.terms(*model.network_inputs(inputs, model.geometry(inputs)))
        terms = [_answered(rows, inputs) for rows in terms]
        target = model.standardize_target(sample.target.double())
        targets, root = layer.targets(target), weight(target) ** 0.5
        if not equations:
            equations = [NormalEquations(x.shape[1], y.shape[1], x.device) for x, y in zip(terms, targets, strict=True)]
        for system, x, y in zip(equations, terms, targets, strict=True):
            system.add(root * x, root * y)
    layer.assign([system.solve(ridge) for system in equations])


def _answered(rows: Float[Tensor, "R P"], inputs: Inputs) -> Float[Tensor, "A P"]:
    """Rows of the particles that are asked about, which have one row each, or one for each component."""
    if inputs.answered is None:
        return rows
    return rows[inputs.answered.repeat_interleave(len(rows) // inputs.num_particles)]
