"""The published ConvNet as its code has it, in metres and seconds, on weights as Keras stores them.

Written after `models/default_torch.py` of isl-org/DeepLagrangianFluids (MIT licence), independently of the package.
"""

import h5py
import torch

SHAPES = {
    "conv0_fluid": (4, 4, 4, 4, 32),
    "conv0_obstacle": (4, 4, 4, 3, 32),
    "conv1": (4, 4, 4, 96, 64),
    "conv2": (4, 4, 4, 64, 64),
    "conv3": (4, 4, 4, 64, 3),
    "dense0_fluid": (4, 32),
    "dense1": (96, 64),
    "dense2": (64, 64),
    "dense3": (64, 3),
}
RADIUS = 1.5 * 6 * 0.025 / 2
SETTINGS = {
    "mapping": "ball_to_cube_volume_preserving", "window": "poly6", "interpolation": "linear", "align_corners": True,
    "normalize": False,
}  # fmt: skip


def member(layer, name):
    return f"{layer}/MyParticleNetwork/{layer}/{name}:0"


def write_weights(path, generator):
    """Random weights of the published layers."""
    with h5py.File(path, "w") as file:
        for layer, shape in SHAPES.items():
            bound = 0.1 if layer.startswith("dense") else 0.05
            file[member(layer, "kernel")] = (bound * (2 * torch.rand(shape, generator=generator) - 1)).numpy()
            file[member(layer, "bias")] = (0.1 * torch.rand(shape[-1], generator=generator)).numpy()


def step(path, conv, scene, dt=0.02):
    """Positions after gravity alone, and the correction of the network, both (N, 3), m.

    Args:
        path: Weights.
        conv: Convolution of features (M, C) by filters, of points (M, 3), at queries (N, 3), within a radius.
        scene: Positions (N, 3), velocities (N, 3), wall points (B, 3) and their normals (B, 3), gravity (3,).
        dt: Time step, s.
    """
    positions, velocities, walls, normals, gravity = scene
    weights = {}
    with h5py.File(path) as file:
        for layer in SHAPES:
            weights[layer] = [torch.from_numpy(file[member(layer, name)][()]) for name in ("kernel", "bias")]

    def convolved(layer, features, points):
        filters, bias = weights[layer]
        return conv(features, filters, points, fallen, RADIUS, **SETTINGS) + bias

    def dense(layer, features):
        return features @ weights[layer][0] + weights[layer][1]

    faster = velocities + dt * gravity
    fallen = positions + dt * (velocities + faster) / 2
    features = torch.cat([torch.ones(len(positions), 1), faster], dim=1)
    first = [convolved("conv0_obstacle", normals, walls), convolved("conv0_fluid", features, fallen)]
    values = torch.cat([*first, dense("dense0_fluid", features)], dim=1)
    for number in (1, 2, 3):
        activated = values.relu()
        following = convolved(f"conv{number}", activated, fallen) + dense(f"dense{number}", activated)
        values = following + values if following.shape == values.shape else following
    return fallen, values / 128
