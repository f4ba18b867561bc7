"""Laws of the solver: conservation, symmetry, hydrostatics, exact channel flows, agreement with the operators."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles.dense_sph import DenseSPH

from cconv import Box, radius_graph
from cconv.errors import ConfigError, ShapeError, SimulationError
from cconv.scenes.walls import lattice, walls_around
from cconv.sph import KERNELS, QuinticSpline, density, density_rate
from cconv.sph import neighbor_list as module
from cconv.sph.kernel_table import kernel_tables
from cconv.sph.pair_loops import look_up
from cconv.sph.solver import EquationOfState, Scheme, WeaklyCompressibleSPH, check_time_step, largest_time_step

SPACING = 0.1
BOX = Box((0.0, 0.0), (1.0, 1.0), periodic=True)


def shaken(generator, box=BOX, jitter=0.3, spacing=SPACING):
    counts = [round(length / spacing) for length in box.lengths]
    positions = lattice(counts, spacing, box.lower)
    return box.wrap(positions + jitter * spacing * (2 * torch.rand(positions.shape, generator=generator).double() - 1))


def solver_in(box=BOX, spacing=SPACING, kernel=None, scheme=None, **settings):
    settings.setdefault("equation_of_state", EquationOfState(sound_speed=10.0))
    kernel, scheme = kernel or QuinticSpline(spacing, box.dim), scheme or Scheme()
    return WeaklyCompressibleSPH(kernel=kernel, box=box, particle_spacing=spacing, scheme=scheme, **settings)


def state_of(solver, positions, velocities=None, walls=0, viscosity=0.01):
    """The last `walls` particles are walls."""
    particles, dim = positions.shape
    return solver.initial_state(
        positions,
        torch.zeros_like(positions) if velocities is None else velocities,
        masses=torch.full((particles,), solver.particle_spacing**dim),
        viscosities=torch.full((particles,), viscosity),
        is_wall=torch.arange(particles) >= particles - walls,
    )


@pytest.mark.parametrize("name", KERNELS)
def test_tables_are_the_kernel(name):
    kernel = KERNELS[name](0.3, 2)
    r = torch.linspace(0, 0.999 * kernel.support_radius, 1001, dtype=torch.float64)
    for table, exact in zip(kernel_tables(kernel), (kernel.value(r), kernel.derivative(r)), strict=True):
        places = (r * (len(table) - 1) / kernel.support_radius).tolist()
        found = torch.tensor([look_up.py_func(table, place) for place in places])
        assert (found - exact).abs().max() < 1e-6 * exact.abs().max()


@pytest.mark.parametrize("spacing", [0.1, 0.05, 0.04, 0.025, 0.02, math.pi / 10])
def test_pairs_at_the_support_to_rounding_read_nothing_beyond_the_tables(spacing):
    """On a lattice, pairs three spacings apart lie a rounding error within the support of 3 h."""
    box = Box((0.0, 0.0), (10 * spacing,) * 2, periodic=True)
    solver = solver_in(box, spacing)
    for number, table in enumerate(solver._tables):
        assert not table[-1].any()
        guarded = np.full((len(table) + 5, 4), np.nan)
        guarded[: len(table)] = table
        solver._tables = tuple(guarded[: len(table)] if k == number else t for k, t in enumerate(solver._tables))
    state = state_of(solver, lattice((10, 10), spacing, (0.0, 0.0)))
    after = solver.step(state, 1e-4)
    assert (state.densities - 1).abs().max() < 1e-3
    assert torch.isfinite(after.velocities).all()


def mixed(generator, dim, walls, friction=True, density="evolution"):
    """A random state of unequal particles above a moving wall, and a solver with everything switched on."""
    box = Box((0.0,) * dim, (1.0,) * dim, periodic=(True, False, True)[:dim])
    counts = (10, 8, 7)[:dim]
    spacing = 0.1
    positions = lattice(counts, spacing, (0.0, 0.1, 0.0)[:dim])
    positions = positions + 0.03 * (2 * torch.rand(positions.shape, generator=generator, dtype=torch.float64) - 1)
    if dim == 3:
        box = Box((0.0,) * 3, (1.0, 1.0, 0.7), periodic=(True, False, True))
    order = positions[:, 1].argsort(descending=True)
    positions = positions[order]
    particles = len(positions)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(particles, *shape, generator=generator, dtype=torch.float64)

    push = torch.tensor([0.3, -1.0, 0.2][:dim], dtype=torch.float64)
    eos = EquationOfState(rest_density=1.0, sound_speed=7.0, exponent=7.0, background_pressure=0.4)
    scheme = Scheme(density=density, wall_friction=friction, transport_pressure=13.0, artificial_viscosity=0.2)
    solver = solver_in(box, spacing, equation_of_state=eos, scheme=scheme, force=lambda x: push * (1 + x[:, :1]))
    state = solver.initial_state(
        positions,
        uniform(-1, 1, dim),
        masses=uniform(0.8, 1.2) * spacing**dim,
        viscosities=uniform(0.01, 0.2),
        is_wall=torch.arange(particles) >= particles - walls,
    )
    state = replace(state, densities=uniform(0.9, 1.1), transport_velocities=uniform(-1, 1, dim))
    return solver, state, eos, box


@pytest.mark.parametrize(("dim", "walls", "friction"), [(2, 30, True), (2, 30, False), (2, 0, True), (3, 120, True)])
def test_a_step_is_that_of_sums_over_all_pairs(dim, walls, friction, generator):
    solver, state, eos, box = mixed(generator, dim, walls, friction)
    dense, fluid = DenseSPH(state, QuinticSpline(SPACING, dim), box), ~state.is_wall
    force = solver._force(state.positions)
    pressures = torch.from_numpy(eos.pressure(state.densities.numpy()))
    p, u, v = dense.walls(pressures, force)
    rho = torch.where(state.is_wall, torch.from_numpy(eos.density(p.numpy())), state.densities)
    accelerations, shifts = dense.accelerations(
        p, u, v, rho, state.viscosities * eos.rest_density, friction, 13.0, 0.2, 7.0, SPACING
    )
    accelerations = accelerations + force * fluid[:, None]
    step = 1e-6
    after = solver.step(state, step)
    found = (after.velocities - state.velocities) / step
    found_shifts = (after.transport_velocities - after.velocities) / (0.5 * step)
    torch.testing.assert_close(found, accelerations, rtol=0, atol=1e-5 * float(accelerations.abs().max()))
    torch.testing.assert_close(found_shifts, shifts, rtol=0, atol=1e-5 * float(shifts.abs().max()))
    torch.testing.assert_close(after.positions, box.wrap(state.positions + step * after.transport_velocities))
    rates = DenseSPH(after, QuinticSpline(SPACING, dim), box).density_rates(after.velocities, rho)
    found_rates = (after.densities - rho)[fluid] / step
    torch.testing.assert_close(found_rates, rates[fluid], rtol=0, atol=1e-5 * float(rates.abs().max()))


def test_renormalised_densities_are_those_of_sums_over_all_pairs(generator):
    """Near the surface the sum of volumes is below 1, inside above: both cases of the filter occur."""
    solver, state, _, box = mixed(generator, 2, 0)
    filtering, plain = (
        solver_in(
            box,
            equation_of_state=solver.equation_of_state,
            scheme=Scheme(density="evolution", renormalize_every=steps),
        )
        for steps in (1, 0)
    )
    evolved, found = plain.step(state, 1e-9), filtering.step(state, 1e-9)
    dense = DenseSPH(evolved, QuinticSpline(SPACING, 2), box)
    volumes = (state.masses / evolved.densities * dense.w).sum(dim=1)
    assert (volumes < 0.95).any()
    assert (volumes > 1.05).any()
    torch.testing.assert_close(found.densities, dense.shepard(evolved.densities), rtol=1e-6, atol=0.0)


def test_steps_leave_what_they_were_given_and_share_no_memory(generator):
    for dim in (2, 3):
        solver, state, _, _ = mixed(generator, dim, 20)
        given = {name: value.clone() for name, value in vars(state).items() if isinstance(value, torch.Tensor)}
        once = solver.step(state, 1e-3)
        assert all(torch.equal(getattr(state, name), value) for name, value in given.items())
        kept = once.positions.clone()
        twice = solver.step(once, 1e-3)
        once.positions.zero_()
        again = solver.step(replace(once, positions=kept), 1e-3)
        assert torch.equal(again.velocities, twice.velocities)


def test_neighbours_follow_walls_that_are_released(generator):
    solver, state, _, _ = mixed(generator, 2, 30)
    free = replace(state, is_wall=torch.zeros_like(state.is_wall))
    solver.step(state, 1e-4)
    other, _, _, _ = mixed(torch.Generator().manual_seed(0), 2, 30)
    assert torch.equal(solver.step(free, 1e-4).velocities, other.step(free, 1e-4).velocities)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_summed_density_is_the_operators(dim, generator):
    box = Box((0.0,) * dim, (1.0,) * dim, periodic=True)
    solver = solver_in(box)
    state = state_of(solver, shaken(generator, box))
    edges = radius_graph(state.positions, 0.3, box)
    torch.testing.assert_close(
        state.densities, density(state.masses, edges, QuinticSpline(SPACING, dim)), rtol=1e-6, atol=0.0
    )


def test_density_evolves_by_the_rate_of_density(generator):
    # With equal densities m_j/ρ_j ρ_i = m_j: the continuity equation is D2.
    solver = solver_in(scheme=Scheme(density="evolution"))
    positions = shaken(generator)
    velocities = torch.randn(positions.shape, generator=generator, dtype=torch.float64)
    before = state_of(solver, positions, velocities)
    after = solver.step(before, 1e-6)
    edges = radius_graph(after.positions, 0.3, BOX)
    rate = density_rate(after.masses, after.velocities, edges, QuinticSpline(SPACING, 2))
    torch.testing.assert_close((after.densities - before.densities) / 1e-6, rate, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("density_scheme", ["summation", "evolution"])
@pytest.mark.parametrize("transport", [0.0, 100.0])
def test_momentum_is_conserved_without_walls_and_forces(density_scheme, transport, generator):
    solver = solver_in(scheme=Scheme(density=density_scheme, transport_pressure=transport, artificial_viscosity=0.1))
    positions = shaken(generator)
    velocities = torch.randn(positions.shape, generator=generator, dtype=torch.float64)
    state = state_of(solver, positions, velocities)
    before = state.velocities.sum(dim=0)
    for _ in range(50):
        state = solver.step(state, 1e-3)
    assert (state.velocities.sum(dim=0) - before).abs().max() < 1e-11
    assert not torch.equal(state.velocities, velocities)


def test_a_lattice_at_rest_stays(generator):
    solver = solver_in(scheme=Scheme(transport_pressure=100.0))
    start = lattice((10, 10), SPACING, (0.0, 0.0))
    state = state_of(solver, start)
    for _ in range(20):
        state = solver.step(state, 1e-3)
    assert (state.positions - start).abs().max() < 1e-9


def test_transport_velocity_moves_particles_apart_and_their_centre_not(generator):
    positions = shaken(generator)
    without = solver_in()
    alone = without.step(state_of(without, positions), 1e-3)
    assert torch.equal(alone.transport_velocities, alone.velocities)
    solver = solver_in(scheme=Scheme(transport_pressure=100.0))
    state = solver.step(state_of(solver, positions), 1e-3)
    shifts = state.transport_velocities - state.velocities
    edges = radius_graph(positions, 0.07, BOX)  # close pairs
    apart = ((shifts[edges.receivers] - shifts[edges.senders]) * edges.displacements).sum(dim=1)
    assert shifts.sum(dim=0).abs().max() < 1e-12
    assert len(edges) > 10
    assert (apart > 0).double().mean() > 0.8


def test_motion_does_not_depend_on_how_often_neighbours_are_searched_nor_on_threads(generator, monkeypatch):
    monkeypatch.setattr(module, "_PAIRS_PER_WORKER", 500)
    workers = []
    real = module.run_on_workers
    monkeypatch.setattr(module, "run_on_workers", lambda work, count: (workers.append(count), real(work, count)))
    positions = shaken(generator)
    velocities = torch.randn(positions.shape, generator=generator, dtype=torch.float64)

    def run(skin):
        solver = solver_in(skin=skin)
        state = state_of(solver, positions, velocities)
        for _ in range(40):
            state = solver.step(state, 2e-3)
        return state.positions

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    often, seldom = run(0.05), run(1.0)
    assert set(workers) == {2}
    torch.set_num_threads(1)
    alone = run(1.0)
    torch.set_num_threads(threads)
    assert torch.equal(often, seldom)
    assert torch.equal(alone, seldom)


def test_rotated_scenes_give_rotated_motion(generator):
    """Turned by 0.4 and mirrored, in open space: only rounding differs."""
    box = Box((-5.0, -5.0), (5.0, 5.0))
    disc = lattice((14, 14), SPACING, (-0.7, -0.7))
    disc = disc[disc.norm(dim=1) < 0.6] + 0.02 * torch.rand((), generator=generator)
    velocities = torch.randn(disc.shape, generator=generator, dtype=torch.float64)
    turn = torch.tensor([[math.cos(0.4), -math.sin(0.4)], [-math.sin(0.4), -math.cos(0.4)]], dtype=torch.float64)

    def run(positions, velocities):
        solver = solver_in(box, scheme=Scheme(density="evolution", artificial_viscosity=0.2))
        state = state_of(solver, positions, velocities)
        for _ in range(30):
            state = solver.step(state, 1e-3)
        return state.positions

    torch.testing.assert_close(
        run(disc @ turn.T, velocities @ turn.T), run(disc, velocities) @ turn.T, rtol=0, atol=1e-9
    )


def test_hydrostatic_pressure_holds_the_water_up():
    """Exact hydrostatic densities on a lattice over a bottom: no acceleration away from the surface."""
    spacing, sound_speed = 0.05, 10.0
    width, height = 10, 20
    fluid = lattice((width, height), spacing, (0.0, 0.0))
    walls = walls_around((width, height), spacing, (0.0, 0.0), [False, True])
    box = Box((0.0, -0.2), (width * spacing, 1.5), periodic=(True, False))
    gravity = torch.tensor([0.0, -1.0], dtype=torch.float64)
    solver = solver_in(
        box, spacing, scheme=Scheme(density="evolution"), equation_of_state=EquationOfState(sound_speed=sound_speed),
        force=lambda positions: gravity.expand_as(positions),
    )  # fmt: skip
    bottom = walls.positions[walls.positions[:, 1] < 0]
    state = state_of(solver, torch.cat([fluid, bottom]), walls=len(bottom))
    state.densities[: len(fluid)] = 1 + (1 - fluid[:, 1]) / sound_speed**2
    accelerations = (solver.step(state, 1e-4).velocities - state.velocities) / 1e-4
    deep = fluid[:, 1] < 0.8
    assert accelerations[: len(fluid)][deep].norm(dim=1).max() < 0.04


@pytest.mark.parametrize("time", [0.3, 2.0])
def test_couette_flow_follows_its_series(solver_benchmark, time):
    assert solver_benchmark.channel_error(20, lid_speed=1.0, end=time) < 0.02


@pytest.mark.parametrize("time", [0.3, 2.0])
def test_poiseuille_flow_follows_its_series(solver_benchmark, time):
    assert solver_benchmark.channel_error(20, force=0.8, end=time) < 0.02


def test_walls_that_let_slip_hold_nothing(solver_benchmark):
    _, speeds = solver_benchmark.channel(20, force=0.8, end=0.3, wall_friction=False)
    torch.testing.assert_close(speeds, torch.full_like(speeds, 0.24), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("exponent", [1.0, 7.0])
def test_equation_of_state_has_its_inverse_and_the_speed_of_sound(exponent):
    eos = EquationOfState(rest_density=2.0, sound_speed=3.0, exponent=exponent, background_pressure=0.5)
    densities = torch.linspace(1.9, 2.1, 5, dtype=torch.float64).numpy()
    assert eos.density(eos.pressure(densities)) == pytest.approx(densities)
    slope = (eos.pressure(densities[2] + 1e-6) - eos.pressure(densities[2] - 1e-6)) / 2e-6
    assert slope == pytest.approx(eos.sound_speed**2)


def test_time_step_limits_name_their_condition():
    scales = {"particle_spacing": 0.1, "sound_speed": 10.0, "reference_speed": 1.0}
    assert largest_time_step(**scales) == pytest.approx(0.25 * 0.1 / 11)
    assert largest_time_step(**scales, viscosity=5.0) == pytest.approx(0.25 * 0.01 / 5)
    check_time_step(largest_time_step(**scales, force=1e6), **scales, force=1e6)
    for setting, word in (({}, "sound"), ({"viscosity": 5.0}, "viscosity"), ({"force": 1e6}, "force")):
        with pytest.raises(ConfigError, match=rf"`time_step` must be .* {word}.*got 0\.1"):
            check_time_step(0.1, **scales, **setting)


def test_bad_input_is_refused(generator):
    solver = solver_in(Box((0.0, 0.0), (1.0, 1.0)))
    outside = torch.tensor([[0.5, 0.5], [1.5, 0.5]], dtype=torch.float64)
    with pytest.raises(ConfigError, match=r"within the box, got 1 outside, the first is particle 1 at \(1.5, 0.5\)"):
        state_of(solver, outside)
    with pytest.raises(ConfigError, match="particles 0 and 1 at a distance of 0.001"):
        state_of(solver, torch.tensor([[0.5, 0.5], [0.501, 0.5]], dtype=torch.float64))
    with pytest.raises(ShapeError, match="velocities"):
        state_of(solver, outside / 2, torch.zeros(3, 2))
    with pytest.raises(ConfigError, match="summation, evolution"):
        Scheme(density="sumation")
    with pytest.raises(ConfigError, match="renormalize_every"):
        Scheme(renormalize_every=5)
    with pytest.raises(ConfigError, match=r"`kernel` must have the dimension of `box` \(2\), got 3"):
        solver_in(kernel=QuinticSpline(SPACING, 3))
    with pytest.raises(ConfigError, match="skin"):
        solver_in(skin=-0.1)
    with pytest.raises(ConfigError, match="periodic axis 0"):
        solver_in(Box((0.0, 0.0), (0.5, 1.0), periodic=True))
    with pytest.raises(ShapeError, match="at least one particle, got 0"):
        state_of(solver, torch.zeros(0, 2, dtype=torch.float64))
    learned = torch.full((1, 2), 0.5, requires_grad=True)
    assert not solver.step(state_of(solver, learned), 1e-3).positions.requires_grad


def test_a_blown_up_simulation_is_told(generator):
    solver = solver_in(Box((0.0, 0.0), (1.0, 1.0)))
    positions = shaken(generator, Box((0.2, 0.2), (0.8, 0.8)))
    velocities = 1e3 * torch.ones_like(positions)
    with pytest.raises(SimulationError, match="step 1: .* no longer in the box"):
        solver.step(state_of(solver, positions, velocities), 1e-2)
