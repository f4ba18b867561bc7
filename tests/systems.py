"""Small scenes that tests build in memory."""

import math
from pathlib import Path

import torch

from cconv.data.dataset import open_dataset
from cconv.data.trajectory import Boundary, Frame, Scene, Trajectory
from cconv.data.window import Window
from cconv.domain import Box
from cconv.models.model import Model, build_model
from cconv.networks import ARCHITECTURES, RadialNetSettings
from cconv.sph.kernels import CubicSpline
from cconv.study.declared.configuration import DEFAULTS, HYPERPARAMETERS, Configuration, configure
from cconv.study.running.problem import Problem
from cconv.tasks import task_named
from cconv.tasks.samples import Sample, WindowSamples, learned_samples, make_sample, make_step_sample
from cconv.tasks.task import StepTask, as_field, as_step


def periodic_scene(particles_per_side: int = 8) -> Scene:
    """A periodic unit square of particles without walls."""
    return Scene(
        name="square",
        dim=2,
        particle_spacing=1 / particles_per_side,
        frame_dt=0.01,
        box=Box([0, 0], [1, 1], True),
        force=None,
        has_boundary=False,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )


def periodic_frame(generator: torch.Generator, particles_per_side: int = 8) -> Frame:
    """A jittered lattice in the unit square, with a smooth velocity field and unit density."""
    spacing = 1 / particles_per_side
    ticks = (torch.arange(particles_per_side, dtype=torch.float64) + 0.5) * spacing
    positions = torch.cartesian_prod(ticks, ticks)
    positions = positions + 0.3 * spacing * (
        torch.rand(positions.shape, generator=generator, dtype=torch.float64) - 0.5
    )
    phase = 2 * math.pi * (positions + torch.rand(2, generator=generator, dtype=torch.float64))
    velocities = torch.stack([torch.sin(phase[:, 0]) + torch.cos(phase[:, 1]), torch.sin(phase[:, 1])], dim=1)
    particles = particles_per_side**2
    return Frame(
        positions=positions.float(),
        velocities=velocities.float(),
        masses=torch.full((particles,), spacing**2),
        particle_types=torch.zeros(particles, dtype=torch.int64),
        boundary=None,
    )


def periodic_trajectory(generator: torch.Generator, num_frames: int = 3, particles_per_side: int = 8) -> Trajectory:
    """Independent frames of the periodic scene."""
    frames = [periodic_frame(generator, particles_per_side) for _ in range(num_frames)]
    return Trajectory(
        name="0",
        first_frame=0,
        positions=torch.stack([frame.positions for frame in frames]),
        velocities=torch.stack([frame.velocities for frame in frames]),
        masses=frames[0].masses,
        particle_types=frames[0].particle_types,
        boundary=None,
    )


def with_walls(frame: Frame, normals: bool = True) -> Frame:
    """The frame with wall points along y = 0."""
    points = torch.stack([torch.linspace(0, 1, 9)[:-1], torch.zeros(8)], dim=1)
    up = torch.tensor([[0.0, 1.0]]).expand(8, 2).clone()
    return Frame(
        positions=frame.positions,
        velocities=frame.velocities,
        masses=frame.masses,
        particle_types=frame.particle_types,
        boundary=Boundary(positions=points, normals=up if normals else None),
    )


def window_of(frame: Frame, generator: torch.Generator, history: int = 6, future: int = 1) -> Window:
    """Frames of smooth motion that end with the particles and walls of a frame, and some that follow."""
    times = torch.arange(1 - history, future + 1)[:, None, None]
    jitter = torch.rand(len(times), *frame.positions.shape, generator=generator) - 0.5
    path = frame.positions + 0.01 * times * frame.velocities + 0.001 * jitter * (times != 0)
    return Window(
        positions=path[:history],
        future=path[history:],
        masses=frame.masses,
        particle_types=frame.particle_types,
        boundary=frame.boundary,
        trajectory="0",
        frame=history - 1,
    )


def still_window(walls: torch.Tensor, fluid: torch.Tensor) -> Window:
    """Two equal frames of wall particles (S, D) and fluid (M, D)."""
    present = torch.cat([walls, fluid])
    return Window(
        positions=torch.stack([present, present]),
        future=torch.empty(0, *present.shape),
        masses=torch.ones(len(present)),
        particle_types=(torch.arange(len(present)) < len(walls)).long(),
        boundary=None,
        trajectory="0",
        frame=1,
    )


def observed_and_sample(
    frame: Frame, scene: Scene, task: str, generator: torch.Generator
) -> tuple[Frame | Window, Sample]:
    """What a model of a task is asked about, a frame or a window that ends with it, and the sample of that."""
    asked = task_named(task)
    if isinstance(asked, StepTask):
        window = window_of(frame, generator)
        return window, make_step_sample(window, scene, asked)
    return frame, make_sample(frame, scene, as_field(asked))


def kernel(scene: Scene) -> CubicSpline:
    """The scene's cubic spline with h = spacing."""
    return CubicSpline(scene.particle_spacing, scene.dim)


def samples(generator: torch.Generator, count: int, task: str = "density_rate", trajectory: str = "0") -> list[Sample]:
    """Samples of independent frames of the periodic scene."""
    scene = periodic_scene()
    return [
        make_sample(periodic_frame(generator), scene, task_named(task), trajectory, index) for index in range(count)
    ]


def problem(generator: torch.Generator, task: str = "density_rate") -> Problem:
    """Four training and two validation frames of the periodic scene."""
    scene = periodic_scene()
    return Problem(
        scene=scene,
        task=task_named(task),
        train_samples=samples(generator, 4, task, "train"),
        valid_samples=samples(generator, 2, task, "valid"),
    )


def steps_problem(generator: torch.Generator) -> Problem:
    """Three training windows of smooth motion in the periodic scene, and one to roll out from."""
    scene, task = periodic_scene(), as_step(task_named("acceleration"))
    train = [window_of(periodic_frame(generator), generator, future=2) for _ in range(3)]
    valid = [window_of(periodic_frame(generator), generator, future=3)]
    return Problem(
        scene=scene,
        task=task,
        train_samples=WindowSamples(train, scene, task),
        valid_samples=WindowSamples(valid, scene, task),
    )


def configured(given: Configuration = DEFAULTS, /, **parameters) -> Configuration:
    """A configuration, by default the published one, with some hyperparameters, named by the ends of their paths.

    Those of another architecture are left out, so that one call serves all architectures.
    """
    architecture = parameters.get("architecture", given.network.architecture)
    foreign = {name for settings in ARCHITECTURES.values() for name in settings.model_fields}
    foreign -= {*ARCHITECTURES[architecture].model_fields}
    paths = {path.rpartition(".")[2]: path for path in HYPERPARAMETERS}
    return configure({paths[name]: value for name, value in parameters.items() if name not in foreign}, given)


def model_of(
    configuration: Configuration,
    scene: Scene,
    task: str,
    train_samples: list[Sample],
    generator: torch.Generator | None = None,
) -> Model:
    """A fresh model of a task, with all features for one that knows others than the configuration."""
    asked = task_named(task)
    known = set(configuration.features) <= set(asked.features)
    features = configuration.features if known else asked.features
    return build_model(configuration.network, asked, features, scene, train_samples, generator)


def untrained_step(folder: Path) -> Model:
    """A model of steps on a data set, with the weights that it begins with."""
    flow, task = open_dataset(folder), as_step(task_named("acceleration"))
    samples = list(learned_samples(flow, "train", task))
    return build_model(RadialNetSettings(layers=1), task, task.features, flow.scene, samples)
