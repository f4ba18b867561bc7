"""Networks of continuous convolutions."""

from importlib import import_module

from cconv.nn.continuous_conv import (
    AntisymmetricConv,
    ContinuousConv,
    ConvGeometry,
    antisymmetric_filters,
    continuous_conv,
)
from cconv.nn.conv_net import ConvNet
from cconv.nn.radial_conv import RadialConv, RadialGeometry
from cconv.nn.radial_net import RadialNet

__all__ = [
    "AntisymmetricConv",
    "ContinuousConv",
    "ConvGeometry",
    "ConvNet",
    "RadialConv",
    "RadialGeometry",
    "RadialNet",
    "antisymmetric_filters",
    "continuous_conv",
    "fit_closed_form",
]


def __getattr__(name: str):
    # Fitting reads data sets and returns a model of `cconv.training`, above this package; the name belongs here.
    if name == "fit_closed_form":
        return import_module("cconv.training.closed_form").fit_closed_form
    raise AttributeError(f"module 'cconv.nn' has no attribute {name!r}")
