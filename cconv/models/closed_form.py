"""The closed form: models of a single layer, fitted by least squares in seconds."""

from collections.abc import Callable, Iterable, Sequence

from cconv.data.dataset import Dataset
from cconv.data.targets import Sample, iterate_samples
from cconv.errors import ConfigError
from cconv.models.model import FieldModel, NetworkConfig, build_field_model
from cconv.networks.linear_terms import NormalEquations, linear_layer
from cconv.sph.kernels import kernel_named


def fit_closed_form(
    dataset: Dataset,
    task: str = "density_rate",
    *,
    network: NetworkConfig | None = None,
    kernel: str = "cubic_spline",
    smoothing_length: float | None = None,
    ridge: float = 1e-10,
    progress: Callable[[Iterable], Iterable] = iter,
) -> FieldModel:
    """Fit a model of a single layer to the training split of a data set.

    Least squares over all particles of all frames, accumulated frame by frame in float64 normal equations. The model
    saves, loads and evaluates like a trained one.

    Args:
        dataset: Data set.
        task: "density_rate" or "density_gradient".
        network: Basis, message, cutoff, window, mapping ... of the layer; by default 16 radial terms on differences to
            the neighbours within the support of the kernel.
        kernel: SPH kernel of the target.
        smoothing_length: Its h, length; None for the particle spacing.
        ridge: Weight of the squared coefficients, in mean squares of a term.
        progress: Wraps the frames of the last pass, e.g. with a progress bar.

    Raises:
        ConfigError: If the network has several layers, or the terms depend on each other and `ridge` is too small.
    """
    spacing = dataset.scene.particle_spacing
    smoothing_length = smoothing_length or spacing
    field = kernel_named(kernel)(smoothing_length, dataset.scene.dim)
    if network is None:
        network = NetworkConfig(
            layers=1,
            basis="radial",
            message="difference",
            relative_cutoff=field.support_radius / spacing,
        )
    samples = list(iterate_samples(dataset, "train", task, field))
    model = build_field_model(network, dataset.scene, task, kernel, smoothing_length, samples)
    solve_closed_form(model, samples, ridge, progress)
    return model.eval()


def solve_closed_form(
    model: FieldModel, samples: Sequence[Sample], ridge: float = 1e-10, progress: Callable[[Iterable], Iterable] = iter
) -> None:
    """Set the coefficients of a model of a single layer to the least-squares solution on `samples`, in place.

    Raises:
        ConfigError: If the network has several layers, `ridge` is negative, or the terms depend on each other and
            `ridge` is too small.
    """
    if not ridge >= 0:
        raise ConfigError(f"`ridge` must be at least 0, got {ridge}.")
    layer = linear_layer(model.network)
    equations: list[NormalEquations] = []
    for sample in progress(samples):
        inputs = sample.inputs.double()
        terms = layer.terms(*model.network_inputs(inputs, model.geometry(inputs)))
        targets = layer.targets(model.standardize_target(sample.target.double()))
        if not equations:
            equations = [NormalEquations(x.shape[1], y.shape[1]) for x, y in zip(terms, targets, strict=True)]
        for system, x, y in zip(equations, terms, targets, strict=True):
            system.add(x, y)
    layer.assign([system.solve(ridge) for system in equations])
