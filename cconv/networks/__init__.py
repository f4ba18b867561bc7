"""Networks, of continuous convolutions and of message passing, which predict the target of a task."""

from typing import Annotated, get_args

from pydantic import Field

from cconv.networks.conv_net import ConvNet, ConvNetSettings
from cconv.networks.gns import GNS, GNSSettings
from cconv.networks.network import Channels, NetworkSettings, WallInputs
from cconv.networks.radial_net import RadialNet, RadialNetSettings
from cconv.networks.segnn import SEGNN, SEGNNSettings

__all__ = [
    "ARCHITECTURES",
    "GNS",
    "SEGNN",
    "Channels",
    "ConvNet",
    "ConvNetSettings",
    "GNSSettings",
    "NetworkTable",
    "RadialNet",
    "RadialNetSettings",
    "SEGNNSettings",
    "WallInputs",
]

NetworkTable = Annotated[
    ConvNetSettings | RadialNetSettings | GNSSettings | SEGNNSettings, Field(discriminator="architecture")
]
ARCHITECTURES: dict[str, type[NetworkSettings]] = {
    settings.model_fields["architecture"].default: settings for settings in get_args(get_args(NetworkTable)[0])
}
