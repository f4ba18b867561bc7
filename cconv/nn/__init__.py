"""Networks of continuous convolutions in plain PyTorch."""

from cconv.nn.continuous_conv import ContinuousConv, ConvGeometry, continuous_conv
from cconv.nn.conv_net import ConvNet

__all__ = ["ContinuousConv", "ConvGeometry", "ConvNet", "continuous_conv"]
