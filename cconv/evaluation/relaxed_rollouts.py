r"""How good rollouts are as a flow, with one number beside those without relaxation: position, evenness, density.

.. math:: q = \left( \prod_{k=1}^{3} \frac{m_k + \epsilon_k}{m_k^0 + \epsilon_k} \right)^{1/3}

with m the mean measures over some rollouts and m⁰ those of the same rollouts without relaxation, so that plain rollouts
have q = 1, and half of all three measures gives q = 1/2. They are those that Neural SPH (Toshev et al., ICML 2024)
judges relaxations by:

- the mean squared error of the positions over all frames;
- the Sinkhorn divergence from the stored particles in the last frame;
- the mean |ρ - 1| there, with densities below 0.98 counted as 1, but no less than that of the stored particles, because
  a flow that is more even than the true one is no better.

Differences below ε, a thousandth of a particle spacing and 1e-4 of the density, do not count. In a rollout that
diverges, every frame that is not reached is half the box off, the Sinkhorn divergence is that of particles half the box
off, and |ρ - 1| is 1: no flow is worse.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.evaluation.particle_distribution import FREE_SURFACE, density_error, sinkhorn_divergence, surroundings
from cconv.evaluation.rollout_comparison import check_masses
from cconv.evaluation.rollout_errors import RolloutErrors, rollout_errors_of, worst_error
from cconv.rollout.correctors import Corrector
from cconv.rollout.rollout import StepModel
from cconv.tasks.samples import StepSample

LEAST_SHIFT = 1e-3  # particle spacings; smaller errors of the positions count as this
LEAST_DENSITY_ERROR = 1e-4
WORST_DENSITY_ERROR = 1.0


@dataclass(frozen=True, kw_only=True)
class FlowErrors:
    """Measures of one rollout, or means over several; smaller is better.

    Attributes:
        mse: Mean squared error of the positions over all frames, length².
        sinkhorn: Sinkhorn divergence from the stored particles in the last frame, length².
        density: Mean |ρ - 1| in the last frame, see the module.
    """

    mse: float
    sinkhorn: float
    density: float


def flow_errors(model: StepModel, start: StepSample, correctors: Sequence[Corrector]) -> tuple[FlowErrors, str | None]:
    """Measure a rollout with some correctors over all frames that are known after its start.

    Args:
        model: Model of a step task.
        start: The start, with at least one frame of future.
        correctors: What corrects every frame; the model's own relaxation does not count.

    Returns:
        The measures, and why the rollout diverged; None if it did not.

    Raises:
        DataError: If the fluid has no mass, so that there is no density at rest.
    """
    check_masses(start.window.masses, start.window.is_fluid)
    rolled = rollout_errors_of(model, start, correctors)
    if rolled.diverged is not None:
        worst = worst_error(start.scene.box) * start.scene.dim
        return FlowErrors(mse=rolled.error, sinkhorn=worst, density=WORST_DENSITY_ERROR), rolled.diverged
    return _of_finished(rolled, start), None


def mean_errors(found: Sequence[FlowErrors]) -> FlowErrors:
    """Mean of the measures of at least one rollout."""
    means = (math.fsum(values) / len(found) for values in zip(*map(_values, found), strict=True))
    return FlowErrors(**dict(zip(("mse", "sinkhorn", "density"), means, strict=True)))


def relative_quality(found: FlowErrors, plain: FlowErrors, scene: Scene) -> float:
    """The number q of the module: below 1 the rollouts are better flows than the plain ones.

    Args:
        found: Mean measures with a relaxation.
        plain: Those of the same rollouts without one.
        scene: Their scene.
    """
    shift = (LEAST_SHIFT * scene.particle_spacing) ** 2
    least = (shift, shift, LEAST_DENSITY_ERROR)
    logarithms = [
        math.log((value + floor) / (without + floor))
        for value, without, floor in zip(_values(found), _values(plain), least, strict=True)
    ]
    return math.exp(math.fsum(logarithms) / len(logarithms))


def _values(errors: FlowErrors) -> tuple[float, float, float]:
    return errors.mse, errors.sinkhorn, errors.density


def _of_finished(rolled: RolloutErrors, start: StepSample) -> FlowErrors:
    """Measures of a rollout that reached its last frame."""
    scene, fluid, stored = start.scene, start.window.is_fluid, start.window.future[-1].double()
    masses = start.window.masses.double()
    volumes = masses / masses[fluid].mean() * scene.particle_spacing**scene.dim
    densities = [_density_error(frame, volumes, fluid, scene) for frame in (rolled.last, stored)]
    return FlowErrors(
        mse=rolled.error,
        sinkhorn=sinkhorn_divergence(rolled.last[fluid], stored[fluid], scene.box),
        density=max(densities),
    )


@torch.no_grad()
def _density_error(frame: Tensor, volumes: Tensor, fluid: Tensor, scene: Scene) -> float:
    around = surroundings(frame, volumes, scene.box, scene.particle_spacing)
    return density_error(around.densities[fluid], FREE_SURFACE)
