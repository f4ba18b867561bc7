"""Networks of continuous convolutions."""

from cconv.nn.continuous_conv import (
    AntisymmetricConv,
    ContinuousConv,
    ConvGeometry,
    antisymmetric_filters,
    continuous_conv,
)
from cconv.nn.conv_net import ConvNet

__all__ = [
    "AntisymmetricConv",
    "ContinuousConv",
    "ConvGeometry",
    "ConvNet",
    "antisymmetric_filters",
    "continuous_conv",
]
