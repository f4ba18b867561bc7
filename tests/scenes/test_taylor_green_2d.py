import math

import torch
from torch.func import jacrev, vmap

from cconv.scenes.taylor_green_2d import TaylorGreen2D

SCENE = TaylorGreen2D(particles_per_side=10)
PHASE = torch.tensor([0.3, 0.8], dtype=torch.float64)


def random_points(generator, count=50):
    return torch.rand(count, 2, generator=generator, dtype=torch.float64)


def test_velocity_is_free_of_divergence(generator):
    points = random_points(generator)
    gradients = vmap(jacrev(lambda point: SCENE.velocity(point, 0.1, PHASE)))(points)
    divergence = gradients.diagonal(dim1=1, dim2=2).sum(dim=1)
    torch.testing.assert_close(divergence, torch.zeros_like(divergence))
    assert gradients.abs().max() > 1


def test_velocity_diffuses_as_momentum_does(generator):
    # The nonlinear term is a gradient that pressure balances, so du/dt = nu * laplacian(u).
    points = random_points(generator)
    hessians = vmap(jacrev(jacrev(lambda point: SCENE.velocity(point, 0.1, PHASE))))(points)
    laplacians = hessians.diagonal(dim1=2, dim2=3).sum(dim=2)
    time = torch.tensor(0.1, dtype=torch.float64)
    step = 1e-5
    rates = (SCENE.velocity(points, 0.1 + step, PHASE) - SCENE.velocity(points, float(time) - step, PHASE)) / (2 * step)
    torch.testing.assert_close(rates, SCENE.viscosity * laplacians, rtol=1e-6, atol=1e-8)


def test_velocity_is_periodic(generator):
    points = random_points(generator)
    shift = torch.tensor([1.0, -2.0], dtype=torch.float64)
    torch.testing.assert_close(SCENE.velocity(points + shift, 0.0, PHASE), SCENE.velocity(points, 0.0, PHASE))


def test_particles_stay_on_their_streamline(generator):
    # The pattern only decays, so sin(2 pi x) sin(2 pi y) shifted by a quarter, the stream function, is carried along.
    def stream_function(positions):
        x, y = (2 * math.pi * (positions - PHASE)).unbind(dim=-1)
        return x.cos() * y.cos()

    start = positions = random_points(generator)
    for frame in range(20):
        positions = SCENE.advance(positions, frame * SCENE.frame_dt, PHASE)
    torch.testing.assert_close(stream_function(positions), stream_function(start), rtol=0, atol=1e-6)
    assert SCENE.box.displacement(positions, start).abs().max() > 0.05


def test_advancing_converges_with_fourth_order(generator):
    start = random_points(generator)

    def end(steps):
        scene = TaylorGreen2D(frame_dt=0.5, steps_per_frame=steps)
        return scene.advance(start, 0.0, PHASE)

    reference = end(256)
    coarse, fine = (SCENE.box.displacement(end(steps), reference).norm() for steps in (8, 16))
    assert 12 < coarse / fine < 24


def test_starting_lattice_fills_the_box_within_its_jitter(generator):
    positions = SCENE.initial_positions(generator)
    ticks = (torch.arange(10, dtype=torch.float64) + 0.5) / 10
    offsets = SCENE.box.displacement(positions, torch.cartesian_prod(ticks, ticks))
    assert offsets.abs().max() <= SCENE.jitter * SCENE.particle_spacing
    assert offsets.std() > 0.01
    assert torch.equal(positions, SCENE.box.wrap(positions))
