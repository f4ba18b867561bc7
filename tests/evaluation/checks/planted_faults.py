"""Analytic SPH as a model, and the same spoiled in one situation: what a check of stability must pass, and catch."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from cconv.domain import Box
from cconv.neighbors import radius_graph
from cconv.tasks import task_named
from cconv.tasks.features import fluid_state


def single(state):
    """A state in float32, as networks compute."""
    values = {name: getattr(state, name).float() for name in ("positions", "velocities", "masses")}
    return replace(state, **values).knowing(state.edges.to(torch.float32), state.densities.float())


@dataclass(frozen=True, kw_only=True)
class Analytic:
    """The analytic field of a task as a predictor, in float32 or float64."""

    task: str
    kernel: object
    dtype: torch.dtype = torch.float32

    def predict(self, frame, scene):
        return self.field(self.state(frame, scene, self.dtype), frame, scene)

    precision = "float32"

    def predict_exactly(self, frame, scene):
        return self.field(self.state(frame, scene, torch.float64), frame, scene)

    def state(self, frame, scene, dtype):
        state = fluid_state(frame, scene.box, self.kernel)
        return single(state) if dtype == torch.float32 else state

    def field(self, state, frame, scene):
        return task_named(self.task).field(state)


@dataclass(frozen=True, kw_only=True)
class Usual:
    """What a planted fault knows of the data, as a trained model would.

    Attributes:
        spacing: Particle spacing.
        neighbors: Median number of neighbours within two spacings.
        fastest: Largest speed.
        rate: Root of the mean square of the target.
    """

    spacing: float
    neighbors: float
    fastest: float
    rate: float


@dataclass(frozen=True, kw_only=True)
class Spoiled(Analytic):
    """The analytic field with a fault.

    Attributes:
        usual: What the fault knows of the data.
        fault: Field, state, frame, scene and `usual` to the spoiled field.
    """

    usual: Usual
    fault: Callable

    def field(self, state, frame, scene):
        return self.fault(super().field(state, frame, scene), state, frame, scene, self.usual, self)


def spoiled(material, fault):
    """The analytic field of a task with a fault (field, state, frame, scene, usual, predictor to the spoiled field)."""
    kernel = material.task.kernel_at(material.scene.particle_spacing, material.scene.dim)
    return Spoiled(task=material.task.name, kernel=kernel, usual=usual_of(material), fault=fault)


def usual_of(material):
    """What is usual in the frames of the checks."""
    spacing = material.scene.particle_spacing
    counts = [
        radius_graph(probe.frame.positions.double(), 2 * spacing, probe.scene.box).row_splits.diff().double()
        for probe in material.plain
    ]
    return Usual(
        spacing=spacing,
        neighbors=float(torch.cat(counts).median()),
        fastest=material.fastest,
        rate=material.typical**0.5,
    )


def neighbors(state, scene, usual):
    return radius_graph(state.positions.double(), 2 * usual.spacing, scene.box).row_splits.diff()


def at(condition, spoiled, field):
    return torch.where(condition[:, None], spoiled, field)


def close_pairs_times(factor):
    """Terms of pairs closer than 0.2 spacings times a factor; displacements scale the terms."""

    def fault(field, state, frame, scene, usual, model):
        close = state.edges.distances < 0.2 * usual.spacing
        displacements = torch.where(close[:, None], factor * state.edges.displacements, state.edges.displacements)
        spoiled = state.knowing(replace(state.edges, displacements=displacements), state.densities)
        return task_named(model.task).field(spoiled)

    return fault


def explodes_beyond_20_times_the_speed(field, state, frame, scene, usual, model):
    return at(state.velocities.norm(dim=1) > 20 * usual.fastest, 1e6 * field, field)


def flips_where_crowded(field, state, frame, scene, usual, model):
    return at(neighbors(state, scene, usual) > 4 / 3 * usual.neighbors, -field, field)


def nan_when_alone(field, state, frame, scene, usual, model):
    return at(neighbors(state, scene, usual) == 0, math.nan * field, field)


def constant_when_alone(field, state, frame, scene, usual, model):
    return at(neighbors(state, scene, usual) == 0, field + usual.rate, field)


def flips_near_walls(field, state, frame, scene, usual, model):
    walls = frame.boundary.positions.double()
    near = radius_graph(walls, 1.5 * usual.spacing, scene.box, queries=state.positions.double())
    return at(near.row_splits.diff() > 0, -field, field)


def zero_at_the_surface(field, state, frame, scene, usual, model):
    return at(neighbors(state, scene, usual) < 0.7 * usual.neighbors, 0 * field, field)


def flips_when_turned(field, state, frame, scene, usual, model):
    spread = state.velocities.var(dim=0)
    return field if spread[0] > spread[1] else -field


def flips_when_mirrored(field, state, frame, scene, usual, model):
    x, v = state.positions - state.positions.mean(dim=0), state.velocities - state.velocities.mean(dim=0)
    return field if (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() >= 0 else -field


def flips_at_half_density(field, state, frame, scene, usual, model):
    sparse = neighbors(state, scene, usual).double().median() < 0.75 * usual.neighbors
    return -field if sparse else field


def wrong_for_stretched_lattices(field, state, frame, scene, usual, model):
    """Spread of the neighbours along the first axis against that along the others."""
    edges = radius_graph(state.positions.double(), 1.6 * usual.spacing, scene.box)
    extents = edges.displacements.square().mean(dim=0)
    return field if extents.min() > 0.8 * extents.max() else -field


def depends_on_the_place(field, state, frame, scene, usual, model):
    return field + 0.01 * usual.rate * state.positions[:, :1] / usual.spacing


def depends_on_the_frame_of_reference(field, state, frame, scene, usual, model):
    drift = state.velocities.mean(dim=0).norm()
    return field + usual.rate * (drift > 3 * usual.fastest)


def rate_of_a_translation(field, state, frame, scene, usual, model):
    return field + 0.05 * usual.rate * state.velocities.mean(dim=0).norm() / usual.fastest


def rate_at_rest(field, state, frame, scene, usual, model):
    return field + 0.2 * usual.rate


def drifts(field, state, frame, scene, usual, model):
    """A bias that is small among the rates, so that no error at one time shows it."""
    return field + 0.06 * usual.rate


def cancels_in_float32(field, state, frame, scene, usual, model):
    return (field + 1e5 * usual.rate) - 1e5 * usual.rate


def flips_the_fastest_percent(field, state, frame, scene, usual, model):
    speeds = state.velocities.norm(dim=1)
    return at(speeds >= speeds.quantile(0.99), -field, field)


def wrong_in_compressed_clumps(field, state, frame, scene, usual, model):
    """Only clumps: fluid that is as dense everywhere is predicted as it is."""
    counts = neighbors(state, scene, usual).double()
    clump = (counts > 1.3 * usual.neighbors) & (counts > 1.2 * counts.median())
    return at(clump, 0 * field, field)


def ignores_periodic_axes(field, state, frame, scene, usual, model):
    open_box = Box(scene.box.lower, scene.box.upper, False)
    state = model.state(frame, replace(scene, box=open_box), state.positions.dtype)
    return task_named(model.task).field(state)


def saturates(field, state, frame, scene, usual, model):
    return 6 * usual.rate * torch.tanh(field / (6 * usual.rate))


def even_in_the_velocities(field, state, frame, scene, usual, model):
    """Right for the flow of the data; its reverse changes nothing."""
    x, v = state.positions - state.positions.mean(dim=0), state.velocities - state.velocities.mean(dim=0)
    turning = x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]
    return field * turning.sum().sign()


def flips_when_tilted(field, state, frame, scene, usual, model):
    """Knows walls along the axes alone."""
    return field if frame.boundary.normals.abs().amax(dim=1).min() > 0.99 else -field


@dataclass(frozen=True)
class Fault:
    """A fault, the check and the words in the label of the finding that must name it, and where it can be planted."""

    spoil: Callable
    check: str
    label: str
    tasks: tuple[str, ...] = ("density_rate", "density_gradient")
    needs_walls: bool = False
    needs_periodic: bool = False
    needs_open: bool = False
    in_3d: bool = False

    @property
    def places(self):
        """Flows in which it can be planted: in 2D, also in 3D where the finding depends on the dimension."""
        periodic = self.needs_periodic or not (self.needs_walls or self.needs_open)
        dims = (2, 3) if self.in_3d else (2,)
        return [{"dim": dim, "walls": self.needs_walls, "periodic": periodic} for dim in dims]


RATE = ("density_rate",)
FAULTS = {
    "sign flipped for pairs closer than 0.2 spacings": Fault(
        close_pairs_times(-1.0), "stress", "clumped", RATE, in_3d=True
    ),
    "zero for pairs closer than 0.2 spacings": Fault(close_pairs_times(0.0), "stress", "clumped", RATE),
    "three times the truth for pairs closer than 0.2 spacings": Fault(
        close_pairs_times(3.0), "stress", "clumped", RATE
    ),
    "explosion beyond 20 times the largest speed": Fault(
        explodes_beyond_20_times_the_speed, "stress", "hundred_times_as_fast"
    ),
    "sign flipped where neighbours are a third more than usual": Fault(
        flips_where_crowded, "stress", "forty_percent_denser", in_3d=True
    ),
    "no number for isolated particles": Fault(nan_when_alone, "stress", "isolated"),
    "a constant for isolated particles": Fault(constant_when_alone, "stress", "isolated"),
    "wrong near walls": Fault(flips_near_walls, "regimes", "near_wall", needs_walls=True),
    "zero at the free surface": Fault(zero_at_the_surface, "regimes", "free_surface", needs_open=True),
    "wrong when turned": Fault(flips_when_turned, "stress", "turned", in_3d=True),
    "wrong when tilted": Fault(flips_when_tilted, "stress", "tilted", needs_walls=True),
    "wrong when mirrored": Fault(flips_when_mirrored, "stress", "mirrored"),
    "wrong at half density": Fault(flips_at_half_density, "stress", "half_density", in_3d=True),
    "wrong for stretched lattices": Fault(wrong_for_stretched_lattices, "stress", "stretched"),
    "dependence on the place": Fault(depends_on_the_place, "stress", "far_away"),
    "dependence on the frame of reference": Fault(depends_on_the_frame_of_reference, "stress", "moving_frame"),
    "rate of a translation": Fault(rate_of_a_translation, "still", "uniform_velocity", RATE),
    "rate at rest": Fault(rate_at_rest, "still", "rest", RATE),
    "a bias that drifts": Fault(drifts, "density", "integrated density", RATE),
    "cancellation in float32": Fault(cancels_in_float32, "precision", "rounding"),
    "wrong for the fastest one in a hundred": Fault(flips_the_fastest_percent, "regimes", "fastest_percent"),
    "wrong in compressed clumps": Fault(wrong_in_compressed_clumps, "stress", "squeezed"),
    "periodic axes ignored": Fault(ignores_periodic_axes, "regimes", "periodic_face", needs_periodic=True),
    "saturation": Fault(saturates, "stress", "ten_times_as_fast", RATE),
    "reversed flow taken as it was": Fault(even_in_the_velocities, "stress", "reversed", RATE),
}
