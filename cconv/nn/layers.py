"""Typed lists of layers."""

from collections.abc import Iterable, Iterator
from typing import Any, Generic, TypeVar, overload

from torch import nn

Layer = TypeVar("Layer", bound=nn.Module)


class Layers(nn.ModuleList, Generic[Layer]):
    """A list of layers of one type, which keeps the type that `torch.nn.ModuleList` forgets."""

    def __init__(self, layers: Iterable[Layer]):
        super().__init__(layers)

    @overload
    def __getitem__(self, index: slice) -> "Layers[Layer]": ...

    @overload
    def __getitem__(self, index: int) -> Layer: ...

    def __getitem__(self, index: Any) -> Any:
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[Layer]:
        return (self[index] for index in range(len(self)))
