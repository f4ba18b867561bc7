"""What the SPH solver gets right, and how fast it is: flows with known solutions, an experiment, an independent solver.

    python experiments/benchmarks/solver.py --out runs/solver [--reference FOLDER_OF_LAGRANGEBENCH_SETS]

Prints each check with what must hold; writes `checks.csv`, `speed.csv`, `energy.csv`, `dam_break_front.csv`, a picture.
`--reference` names a folder with data sets of LagrangeBench (2D_TGV_2500, 2D_RPF_3200, 2D_LDC_2708, 2D_DAM_5740): the
solver starts from their first frame and is compared with what follows.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import seaborn as sns
import torch
from torch import Tensor

from cconv import Box, Dataset, open_dataset, radius_graph
from cconv.data.trajectory import ParticleType
from cconv.scenes import scene_named
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import lattice, walls_around
from cconv.sph import QuinticSpline, density
from cconv.sph.solver import EquationOfState, ParticleState, Scheme, WeaklyCompressibleSPH, largest_time_step

# Tip of the wave in depths H of the column, from the gate, over t √(g/H): a column twice as long as deep in a tank of
# 5.37 H, the published dam break. Source: Lobovský et al., "Experimental investigation of dynamic pressure loads during
# dam break", J. Fluids Struct. 48 (2014), figure 12, H = 300 mm, every fifth point or so.
LOBOVSKY = [
    (0.2093, 0.1305), (0.3046, 0.2161), (0.3998, 0.3245), (0.4954, 0.4018), (0.6097, 0.5045), (0.7050, 0.5834),
    (0.8002, 0.6690), (0.8955, 0.7811), (0.9910, 0.8947), (1.1054, 1.0436), (1.2006, 1.1697), (1.2959, 1.3025),
    (1.4102, 1.4633), (1.5055, 1.6034), (1.6010, 1.7274), (1.6963, 1.8795), (1.8106, 2.0564), (1.9250, 2.2364),
    (2.0011, 2.3677), (2.0967, 2.5270), (2.2110, 2.7231), (2.3063, 2.8855), (2.4015, 3.0432),
]  # fmt: skip
VISCOSITY = 0.1  # of the channels
CASES = {"TGV": "taylor_green_2d", "RPF": "reverse_poiseuille_2d", "LDC": "lid_driven_cavity_2d", "DB": "dam_break_2d"}


def states(scene: SimulatedScene, state: ParticleState, solver=None) -> Iterator[ParticleState]:
    """The start and every step after it."""
    solver = solver or scene.solver()
    while True:
        yield state
        state = solver.step(state, scene.time_step)


def with_transport(scene: SimulatedScene) -> WeaklyCompressibleSPH:
    """The scene's solver with a transport velocity, which the published sets do without."""
    eos = scene.equation_of_state
    return WeaklyCompressibleSPH(
        kernel=QuinticSpline(scene.particle_spacing, scene.dim),
        box=scene.box,
        particle_spacing=scene.particle_spacing,
        equation_of_state=eos,
        scheme=Scheme(transport_pressure=eos.reference_pressure),
    )


TAYLOR_GREEN_SOLVERS = {"as data are made": SimulatedScene.solver, "transport velocity": with_transport}


def taylor_green(per_side: int, solver_of: Callable[[SimulatedScene], WeaklyCompressibleSPH]) -> tuple[float, float]:
    """Measured by analytic decay rate of kinetic energy, less 1, and the largest change of momentum a particle."""
    scene = replace(scene_named("taylor_green_2d", particle_spacing=1 / per_side), time_step=math.inf)
    steps = round(1 / scene.time_step)
    start = scene.initial_state(torch.Generator().manual_seed(0))
    energies, times = [], []
    for step, state in enumerate(islice(states(scene, start, solver_of(scene)), steps)):
        if step % 20 == 0:
            energies.append(float((state.velocities**2).sum()))
            times.append(step * scene.time_step)
    rate = -np.polyfit(times, np.log(energies), 1)[0]
    drift = (state.velocities.mean(dim=0) - start.velocities.mean(dim=0)).abs().max()
    return float(rate / (16 * math.pi**2 * scene.viscosity)) - 1, float(drift)


def channel_error(per_height: int, *, lid_speed: float = 0.0, force: float = 0.0, end: float) -> float:
    """Largest error of a channel's profile by the peak of its series solution."""
    y, speed = channel(per_height, lid_speed=lid_speed, force=force, end=end)
    exact = lid_speed * couette(y, end, VISCOSITY) + force * poiseuille(y, end, VISCOSITY)
    return float((speed - exact).abs().max() / exact.max())


def channel(
    per_height: int, *, lid_speed: float = 0.0, force: float = 0.0, end: float, wall_friction: bool = True
) -> tuple[Tensor, Tensor]:
    """Heights and speeds of the particles of a channel of height 1 that starts at rest."""
    spacing, columns = 1 / per_height, 8
    fluid = lattice((columns, per_height), spacing, (0.0, 0.0))
    walls = walls_around((columns, per_height), spacing, (0.0, 0.0), [False, True])
    eos = EquationOfState(sound_speed=10.0)
    push = torch.tensor([force, 0.0], dtype=torch.float64)
    solver = WeaklyCompressibleSPH(
        kernel=QuinticSpline(spacing, 2),
        box=Box((0.0, -3 * spacing), (columns * spacing, 1 + 3 * spacing), periodic=(True, False)),
        particle_spacing=spacing,
        equation_of_state=eos,
        scheme=Scheme(transport_pressure=eos.reference_pressure, wall_friction=wall_friction),
        force=lambda positions: push.expand_as(positions),
    )
    positions = torch.cat([fluid, walls.positions])
    velocities = torch.zeros_like(positions)
    velocities[positions[:, 1] > 1, 0] = lid_speed
    particles = len(positions)
    state = solver.initial_state(
        positions,
        velocities,
        masses=torch.full((particles,), spacing**2),
        viscosities=torch.full((particles,), VISCOSITY),
        is_wall=torch.arange(particles) >= len(fluid),
    )
    limit = largest_time_step(particle_spacing=spacing, sound_speed=10.0, reference_speed=1.0, viscosity=VISCOSITY)
    steps = math.ceil(end / limit)
    for _ in range(steps):
        state = solver.step(state, end / steps)
    return state.positions[: len(fluid), 1], state.velocities[: len(fluid), 0]


def couette(y: Tensor, t: float, viscosity: float) -> Tensor:
    """Morris, Fox, Zhu, J. Comput. Phys. 136 (1997), eq. 25, for a lid of speed 1."""
    modes = (n * math.pi for n in range(1, 100))
    return y + sum(2 / k * math.cos(k) * torch.sin(k * y) * math.exp(-viscosity * k**2 * t) for k in modes)


def poiseuille(y: Tensor, t: float, viscosity: float) -> Tensor:
    """Morris, Fox, Zhu, J. Comput. Phys. 136 (1997), eq. 21, for a force of 1."""
    modes = (n * math.pi for n in range(1, 100, 2))
    decaying = sum(4 / k**3 * torch.sin(k * y) * math.exp(-viscosity * k**2 * t) for k in modes)
    return (y * (1 - y) / 2 - decaying) / viscosity


def water_column() -> tuple[float, float]:
    """Pressure gradient by ρ g, less 1, and the largest speed by √(gH), after settling for 20 √(H/g)."""
    scene = scene_named("water_column_2d", particle_spacing=1 / 30)
    start = scene.initial_state(torch.Generator().manual_seed(0))
    state = next(islice(states(scene, start), round(20 / scene.time_step), None))
    fluid = ~state.is_wall
    depth = state.positions[fluid, 1].max() - state.positions[fluid, 1]
    inside = depth > 3 * scene.particle_spacing  # the kernel is cut off at the surface
    pressures = scene.equation_of_state.pressure(state.densities[fluid][inside].numpy())
    gradient = np.polyfit(depth[inside].numpy(), pressures, 1)[0]
    return float(gradient) - 1, float(state.velocities[fluid].norm(dim=1).max())


def dam_break_front() -> pd.DataFrame:
    """Position of the front from the rear wall, in depths: measured, and of the published dam break at those times."""
    scene = scene_named("dam_break_2d")
    measured = {round(scaled / scene.time_step): (scaled, travelled) for scaled, travelled in LOBOVSKY}
    edge, rows = 3 * scene.particle_spacing, []
    start = scene.initial_state(torch.Generator().manual_seed(0))
    for step, state in enumerate(islice(states(scene, start), max(measured) + 1)):
        if step in measured:
            scaled, travelled = measured[step]
            computed = float(state.positions[~state.is_wall, 0].max()) + scene.particle_spacing / 2 - edge
            rows.append({"time": scaled, "experiment": scene.column[0] + travelled, "computed": computed})
    return pd.DataFrame(rows)


def restarted(dataset: Dataset) -> tuple[SimulatedScene, ParticleState, int]:
    """The scene of a LagrangeBench set in the state of a stored frame, and which.

    The first where its velocities are known, because they are stored or the scene starts at rest, else the second,
    which has central differences of positions.
    """
    scene, trajectory = scene_named(CASES[dataset.metadata["case"]]), dataset.trajectory("train", 0)
    stored = dataset.scene.velocity_source == "stored"
    frame = 0 if stored or scene.skipped_frames == 0 else 1
    fluid, walls = trajectory.particle_types == ParticleType.FLUID, scene.walls
    positions = torch.cat([walls.positions, trajectory.positions[frame, fluid].double()])
    particles = len(positions)
    state = scene.solver().initial_state(
        positions,
        torch.cat([walls.velocities, trajectory.velocities[frame, fluid].double() * (stored or frame > 0)]),
        masses=torch.full((particles,), scene.particle_spacing**2),
        viscosities=torch.full((particles,), scene.viscosity),
        is_wall=torch.arange(particles) < len(walls),
    )
    return scene, state, frame


def compare_with_reference(folder: Path, frames: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Our run beside that of an independent solver from the same frame: kinetic energies, and histograms at the end."""
    dataset = open_dataset(folder)
    scene, state, first = restarted(dataset)
    trajectory = dataset.trajectory("train", 0)
    fluid = trajectory.particle_types == ParticleType.FLUID
    solver, energies = scene.solver(), []
    last = min(frames, len(trajectory) - 2)
    for frame in range(first, last + 1):
        theirs, ours = trajectory.velocities[frame, fluid].double(), state.velocities[~state.is_wall]
        energies.append(
            {
                "set": folder.name,
                "time": (frame - first) * scene.frame_dt,
                "ours": float((ours**2).sum() / 2) * scene.particle_spacing**2,
                "reference": float((theirs**2).sum() / 2) * scene.particle_spacing**2,
            }
        )
        if frame < last:
            for _ in range(scene.steps_per_frame):
                state = solver.step(state, scene.time_step)
    walls = trajectory.positions[last, ~fluid].double()
    stored = {
        "ours": state.positions[~state.is_wall],
        "reference": trajectory.positions[last, fluid].double(),
    }
    histograms = [_particles(scene, positions, walls, who) for who, positions in stored.items()]
    return pd.DataFrame(energies), pd.concat(histograms).assign(set=folder.name)


def _particles(scene: SimulatedScene, fluid: Tensor, walls: Tensor, who: str) -> pd.DataFrame:
    """Density and number of neighbours of each fluid particle, from stored positions alone."""
    positions = scene.box.wrap(torch.cat([fluid, walls]))
    spacing = scene.particle_spacing
    edges = radius_graph(positions, 3 * spacing, scene.box)
    densities = density(torch.full((len(positions),), spacing**2).double(), edges, QuinticSpline(spacing, 2))
    near = torch.bincount(edges.receivers[edges.distances < 1.45 * spacing], minlength=len(positions))
    return pd.DataFrame({"who": who, "density": densities[: len(fluid)], "neighbours": near[: len(fluid)]})


def step_time(per_side: int, seconds: float = 4.0) -> dict:
    """Milliseconds of a step of the Taylor-Green scene: median and quartiles over blocks of 25 steps."""
    scene = scene_named("taylor_green_2d", particle_spacing=1 / per_side, relaxation_steps=30)
    state, solver = scene.initial_state(torch.Generator().manual_seed(0)), scene.solver()
    blocks, end = [], time.perf_counter() + seconds
    while time.perf_counter() < end or len(blocks) < 4:
        start = time.perf_counter()
        for _ in range(25):
            state = solver.step(state, scene.time_step)
        blocks.append(1e3 * (time.perf_counter() - start) / 25)
    low, median, high = statistics.quantiles(blocks[1:], n=4)
    return {"particles": per_side**2, "ms": median, "low": low, "high": high, "threads": torch.get_num_threads()}


def dam_break_minutes() -> float:
    """Time of a dam break of LagrangeBench's size, relaxed start included, 401 frames."""
    start = time.perf_counter()
    scene = scene_named("dam_break_2d")
    steps = (scene.num_frames - 1) * scene.steps_per_frame
    start_state = scene.initial_state(torch.Generator().manual_seed(0))
    next(islice(states(scene, start_state), steps, None))
    return (time.perf_counter() - start) / 60


def check(what: str, measured: float, bound: str, met: bool) -> dict:
    print(f"{what:72s} {measured:10.3g}   {bound}{'' if met else '   NOT MET'}", flush=True)
    return {"what": what, "measured": measured, "must hold": bound, "met": met}


def decay_of_taylor_green(sides: Sequence[int] = (25, 50, 100)) -> Iterator[dict]:
    """The decay with the solver that makes the data sets, and with a transport velocity, which none of them has."""
    for name, solver_of in TAYLOR_GREEN_SOLVERS.items():
        errors = []
        for per_side in sides:
            error, drift = taylor_green(per_side, solver_of)
            errors.append(abs(error))
            what, falls = f"Taylor-Green {per_side}^2, {name}", len(errors) < 2 or errors[-1] < errors[-2]
            yield check(f"{what}: decay rate / analytic - 1", error, "falls with resolution", falls)
            yield check(f"{what}: largest change of mean momentum", drift, "<= 1e-12", drift <= 1e-12)


def flows_with_known_solutions(out: Path) -> Iterator[dict]:
    for end in (0.3, 1.0, 5.0):
        error = channel_error(40, lid_speed=1.0, end=end)
        yield check(f"Couette at t = {end:g}: largest error / peak", error, "<= 0.02", error <= 0.02)
        error = channel_error(40, force=0.8, end=end)
        yield check(f"Poiseuille at t = {end:g}: largest error / peak", error, "<= 0.02", error <= 0.02)
    gradient, fastest = water_column()
    yield check("Water column: pressure gradient / (rho g) - 1", gradient, "within 0.05", abs(gradient) <= 0.05)
    yield check("Water column: largest speed / sqrt(g H)", fastest, "< 0.01", fastest < 0.01)
    front = dam_break_front()
    front.to_csv(out / "dam_break_front.csv", index=False, float_format="%.5g")
    for end in (1.0, 2.5):
        error = (front.computed / front.experiment - 1)[front.time <= end].abs().max()
        yield check(
            f"Dam break: largest error of the front's position until t = {end:g}", error, "<= 0.1", error <= 0.1
        )


def agreement_with_reference(folder: Path, out: Path) -> Iterator[dict]:
    energies, particles = [], []
    for name, frames in (("2D_TGV_2500", 60), ("2D_RPF_3200", 40), ("2D_LDC_2708", 40), ("2D_DAM_5740", 100)):
        energy, at_end = compare_with_reference(folder / name, frames)
        energies.append(energy)
        particles.append(at_end)
        lively = energy.reference >= 0.1 * energy.reference.max()
        error = (energy.ours / energy.reference - 1)[lively].abs().max()
        yield check(f"{name}: largest error of the energy above a tenth of its peak", error, "<= 0.05", error <= 0.05)
    energies, particles = pd.concat(energies), pd.concat(particles)
    energies.to_csv(out / "energy.csv", index=False, float_format="%.6g")
    draw_reference(energies, particles, out / "reference.png")


def speed(out: Path) -> Iterator[dict]:
    rows = pd.DataFrame([step_time(per_side) for per_side in (25, 50, 100, 200, 316)])
    rows.to_csv(out / "speed.csv", index=False, float_format="%.4g")
    print(rows.to_string(index=False, float_format="%.3g"), flush=True)
    ms = float(rows.ms[rows.particles == 2500].iloc[0])
    yield check("Taylor-Green 50^2: ms a step", ms, "<= 3", ms <= 3)
    minutes = dam_break_minutes()
    yield check("Dam break of 5,740 particles, 401 frames: minutes", minutes, "< 10", minutes < 10)


def draw_reference(energies: pd.DataFrame, particles: pd.DataFrame, path: Path) -> None:
    """Kinetic energy, densities and neighbour counts of both solvers, one row a set."""
    sns.set_theme(style="whitegrid", context="paper")
    names = list(energies["set"].unique())
    figure, panels = plt.subplots(len(names), 3, figsize=(11, 2.4 * len(names)), layout="constrained")
    for (left, middle, right), name in zip(panels, names, strict=True):
        energy, ends = energies[energies["set"] == name], particles[particles["set"] == name]
        left.plot(energy.time, energy.reference, color="C1", lw=3, alpha=0.6, label="reference")
        left.plot(energy.time, energy.ours, color="C0", lw=1.2, label="ours")
        left.set(ylabel=f"{name}\nkinetic energy", xlabel="time")
        left.set_ylim(bottom=0)
        for who, color in (("reference", "C1"), ("ours", "C0")):
            rows = ends[ends.who == who]
            middle.hist(rows.density, bins=np.linspace(0.93, 1.05, 49), color=color, alpha=0.5, label=who)
            counts = np.bincount(rows.neighbours, minlength=11)[:11]
            right.bar(np.arange(11) + (0.2 if who == "ours" else -0.2), counts, width=0.4, color=color, label=who)
        middle.set(xlabel="density (summed over stored particles)", ylabel="particles")
        right.set(xlabel="neighbours within 1.45 dx", ylabel="particles")
    panels[0, 0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/solver"), help="folder to write")
    parser.add_argument("--reference", type=Path, help="folder that holds data sets of LagrangeBench")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = list(speed(arguments.out))
    if arguments.reference is not None:
        rows += agreement_with_reference(arguments.reference, arguments.out)
    rows += decay_of_taylor_green()
    rows += flows_with_known_solutions(arguments.out)
    pd.DataFrame(rows).to_csv(arguments.out / "checks.csv", index=False, float_format="%.4g")


if __name__ == "__main__":
    main()
