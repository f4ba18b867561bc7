import torch

from cconv.data.trajectory import ParticleType, Trajectory, finite_difference_velocities
from cconv.domain import Box

BOX = Box((0.0, 0.0), (1.0, 1.0), periodic=(True, False))


def test_differences_of_uniform_motion_are_its_velocity_across_the_periodic_edge(generator):
    velocity = torch.tensor([0.7, -0.2], dtype=torch.float64)
    start = torch.rand(20, 2, generator=generator, dtype=torch.float64)
    times = 0.1 * torch.arange(8, dtype=torch.float64)
    positions = BOX.wrap(start + times[:, None, None] * velocity)
    torch.testing.assert_close(finite_difference_velocities(positions, 0.1, BOX), velocity.expand(8, 20, 2))


def test_central_differences_of_uniform_acceleration_are_exact_inside():
    times = 0.1 * torch.arange(6, dtype=torch.float64)
    positions = (times**2)[:, None, None].expand(6, 1, 2)
    velocities = finite_difference_velocities(positions, 0.1, Box((0, 0), (1, 1)))
    torch.testing.assert_close(velocities[1:-1, 0, 0], 2 * times[1:-1])


def test_single_frame_has_no_velocity():
    positions = torch.ones(1, 3, 2)
    assert torch.equal(finite_difference_velocities(positions, 0.1, BOX), torch.zeros(1, 3, 2))


def test_frames_are_the_slices_of_a_trajectory(generator):
    positions = torch.rand(4, 3, 2, generator=generator)
    trajectory = Trajectory(
        name="a",
        first_frame=0,
        positions=positions,
        velocities=2 * positions,
        masses=torch.ones(3),
        particle_types=torch.full((3,), int(ParticleType.FLUID)),
        boundary=None,
    )
    frames = list(trajectory)
    assert len(frames) == len(trajectory) == 4
    assert all(torch.equal(frame.positions, positions[index]) for index, frame in enumerate(frames))
    assert torch.equal(trajectory[2].velocities, 2 * positions[2])
