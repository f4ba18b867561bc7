"""Models of others as ours: the published ConvNet with its own weights."""

from pathlib import Path

import torch

from cconv.models.model import Model, ModelConfig
from cconv.models.published_weights import read_published
from cconv.models.standardization import Standardization
from cconv.networks import ConvNetSettings
from cconv.tasks.features import CONSTANT, VELOCITY, WALLS

SPACING, FRAME_DT = 0.05, 0.02  # of the published data, m and s
OUTPUT_SCALE = 1 / 128  # m, of the published network's output


def published_conv_net(path: Path | str) -> Model:
    """The simulator of Ummenhofer et al. (ICLR 2020) with its published weights, a model of `position_correction`.

    Its units, metres and seconds at a particle spacing of 0.05 and a frame of 0.02, become the standardisation of
    features and target. In other scenes it sees lengths in particle spacings and times in frames, as all models do.

    Args:
        path: The published weights, `pretrained_model_weights.h5`.

    Raises:
        DataError: If the file is missing, no HDF5 file, or holds other weights.
    """
    config = ModelConfig(
        task="position_correction",
        kernel="cubic_spline",
        relative_smoothing_length=1.0,
        dim=3,
        particle_spacing=SPACING,
        frame_dt=FRAME_DT,
        history=2,
        features=(CONSTANT, VELOCITY, WALLS),
        wall_scalars=0,
        wall_vectors=1,
        network=ConvNetSettings(coincident="ignored"),
    )
    velocity = FRAME_DT / SPACING  # a metre per second in spacings per frame
    features = Standardization(torch.zeros(4), torch.tensor([1.0, velocity, velocity, velocity]))
    targets = Standardization(torch.zeros(3), torch.full((3,), OUTPUT_SCALE / SPACING))
    model = Model(config, features, targets)
    model.network.load_state_dict(read_published(Path(path), model.network.state_dict()))
    return model.eval()
