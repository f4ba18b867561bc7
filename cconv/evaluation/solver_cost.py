"""The measured cost of the solver itself for a stored frame, which models of steps are compared with."""

import statistics
import time
from dataclasses import dataclass

from cconv.data.restart import restart
from cconv.data.simulate import next_frame
from cconv.data.window import Window
from cconv.ops.workers import torch_threads
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.sph.solver import ParticleState


@dataclass(frozen=True, kw_only=True)
class SolverCost:
    """Cost of all steps of the solver from one stored frame to the next.

    Attributes:
        ms_per_frame: Median time of a frame, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        turns_ms: Time of each turn, ms.
        steps: Steps of a frame.
        threads: Number of threads of the measurement.
        num_particles: Number of fluid particles.
    """

    ms_per_frame: float
    ms_low: float
    ms_high: float
    turns_ms: tuple[float, ...]
    steps: int
    threads: int
    num_particles: int


def measure_solver(scene: SimulatedScene, start: Window, *, threads: int, repeats: int) -> SolverCost:
    """Measure how long the solver takes for the frame after a window, again and again; the first turn is a warm-up.

    Args:
        scene: Scene of the window, e.g. of `find_scene`.
        start: Window of at least two frames.
        threads: Number of torch threads.
        repeats: Timed turns, at least 2.
    """
    return measure_state(scene, restart(scene, start).state, threads=threads, repeats=repeats)


def measure_state(scene: SimulatedScene, state: ParticleState, *, threads: int, repeats: int) -> SolverCost:
    """Measure how long the solver takes for the frame after a state; arguments as of `measure_solver`."""
    with torch_threads(threads):
        times = [time_solver(scene, state) for _ in range(repeats + 1)][1:]
    turns = tuple(1e3 * seconds for seconds in times)
    low, median, high = statistics.quantiles(turns, n=4, method="inclusive")
    return SolverCost(
        ms_per_frame=median,
        ms_low=low,
        ms_high=high,
        turns_ms=turns,
        steps=scene.steps_per_frame,
        threads=threads,
        num_particles=int((~state.is_wall).sum()),
    )


def time_solver(scene: SimulatedScene, state: ParticleState) -> float:
    """Time all steps from a state to the next stored frame, with the search for neighbours, s."""
    solver = scene.solver()
    begin = time.perf_counter()
    next_frame(scene, solver, state)
    return time.perf_counter() - begin
