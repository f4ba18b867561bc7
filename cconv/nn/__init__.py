"""Layers of continuous convolutions."""

from cconv.nn.continuous_conv import (
    AntisymmetricConv,
    ContinuousConv,
    ConvGeometry,
    antisymmetric_filters,
    continuous_conv,
)
from cconv.nn.kinds import Kinds
from cconv.nn.radial_conv import RadialConv, RadialGeometry

__all__ = [
    "AntisymmetricConv",
    "ContinuousConv",
    "ConvGeometry",
    "Kinds",
    "RadialConv",
    "RadialGeometry",
    "antisymmetric_filters",
    "continuous_conv",
]
