"""Networks of continuous convolutions: who answers what a task asks."""

from typing import Annotated, Union

from pydantic import Field

from cconv.networks.conv_net import ConvNet, ConvNetSettings
from cconv.networks.radial_net import RadialNet, RadialNetSettings

__all__ = ["ARCHITECTURES", "ConvNet", "ConvNetSettings", "NetworkTable", "RadialNet", "RadialNetSettings"]

SETTINGS = (ConvNetSettings, RadialNetSettings)
ARCHITECTURES = {settings.model_fields["architecture"].default: settings for settings in SETTINGS}
NetworkTable = Annotated[Union[SETTINGS], Field(discriminator="architecture")]  # noqa: UP007, of the list above
