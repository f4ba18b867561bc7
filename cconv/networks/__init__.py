"""Networks of continuous convolutions."""

from cconv.networks.conv_net import ConvNet
from cconv.networks.radial_net import RadialNet

__all__ = ["ConvNet", "RadialNet"]
