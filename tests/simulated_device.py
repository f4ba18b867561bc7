"""A device of its own, simulated on the CPU: its tensors hold values, and torch sees them on another device.

What mixes tensors of both devices fails as it would on a GPU, and so does what needs the memory of a tensor, e.g. NumPy
or a compiled loop. So a test that passes inside `simulated_device` shows that code runs on any device, which the
machine of the test need not have; it says nothing about speed or about kernels of a GPU. The device bears the name
"lazy", as torch knows that type without asking a driver for it.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("lazy")
CPU = torch.device("cpu")
COPIES = ("aten::_to_copy", "aten::copy_")


class FarTensor(torch.Tensor):
    """A tensor of the simulated device.

    Args:
        held: Its values on the CPU.
    """

    @staticmethod
    def __new__(cls, held):
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, held.size(), device=DEVICE, **layout)

    def __init__(self, held):
        self.held = held

    def __repr__(self):
        return f"far {self.held}"

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return _compute(operation, args, kwargs or {})


def _compute(operation, args, kwargs):
    """The result of an operation, of tensors of one device alone."""
    tensors = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)]
    far = [each for each in tensors if isinstance(each, FarTensor)]
    if len({type(each) for each in tensors if each.ndim}) > 1 and not operation.name().startswith(COPIES):
        raise RuntimeError(f"Expected all tensors to be on the same device, got two devices in {operation.name()}")
    to = kwargs.get("device")
    is_far = bool(far) if to is None else torch.device(to) == DEVICE
    result = operation(*tree_map(_held, args), **tree_map(_held, kwargs))
    returned = operation._schema.returns
    if args and isinstance(args[0], torch.Tensor) and len(returned) == 1 and _is_changed(returned[0]):
        return args[0]
    return tree_map(lambda each: FarTensor(each) if is_far and isinstance(each, torch.Tensor) else each, result)


def _held(value):
    if isinstance(value, FarTensor):
        return value.held
    return CPU if isinstance(value, torch.device) else value


def _is_changed(returned):
    return returned.alias_info is not None and returned.alias_info.is_write


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        return _compute(operation, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Functions of torch that make tensors, or lists of numbers, without an operation that a mode would see."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        to = kwargs.get("device")
        if function in (torch.tensor, torch.as_tensor) and to is not None and torch.device(to) == DEVICE:
            del kwargs["device"]
            return function(*args, **kwargs).to(DEVICE)
        if function is torch.Tensor.new_tensor and args[0].device == DEVICE:
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(DEVICE)
        if function is torch.Tensor.tolist:
            return function(args[0].cpu())
        return function(*args, **kwargs)


@contextmanager
def simulated_device() -> Iterator[torch.device]:
    """Tensors can be moved to the device that is given, and back with `cpu()`."""
    with _Functions(), _Operations():
        yield DEVICE
