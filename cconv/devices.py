"""Devices: which one a wish means on this machine, where the states of particles stand, and when its work is done."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, Literal, TypeVar

import torch

from cconv.errors import ConfigError, shown

AUTO, CPU = "auto", torch.device("cpu")
WISH = re.compile(r"auto|cpu|mps|cuda(:\d{1,3})?")
WISHES = "auto, cpu, cuda, cuda:N or mps"
FLOAT32: Final = "float32"
TF32: Final = "tf32"
BFLOAT16: Final = "bfloat16"
Precision = Literal["float32", "tf32", "bfloat16"]  # of products of matrices

Record = TypeVar("Record")


def find_device(wish: str, name: str = "--device") -> torch.device:
    """The device that a wish means on this machine; with "auto" the first NVIDIA GPU, or else the CPU.

    Apple's GPUs (mps) are only taken where they are named: small networks may be faster in the CPU's compiled loops.

    Args:
        wish: "auto", "cpu", "cuda", "cuda:N" or "mps".
        name: Option or setting that the wish came from, for the message.

    Raises:
        ConfigError: If there is no such device.
    """
    check_wish(wish, name)
    if wish == "cpu" or (wish == AUTO and not torch.cuda.is_available()):
        return CPU
    if wish == "mps":
        if not torch.backends.mps.is_available():
            raise ConfigError(f"`{name}` is mps, and torch finds no Apple GPU on this machine; take cpu or auto.")
        return torch.device("mps")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    number = int(wish.partition(":")[2] or 0)
    if number >= count:
        found = f"{count} of them (cuda:0 to cuda:{count - 1})" if count else f"none{_why_no_cuda()}"
        raise ConfigError(
            f"`{name}` is {wish}, and of NVIDIA GPUs torch finds {found} on this machine; take cpu or auto."
        )
    return torch.device("cuda", number)


def check_wish(wish: str, name: str = "--device") -> None:
    """Raise `ConfigError` unless a wish is for a device that can be, on whatever machine."""
    if not WISH.fullmatch(wish):
        raise ConfigError(f"`{name}` must be {WISHES}, got {shown(wish)}.")


def finest_dtype(device: torch.device) -> torch.dtype:
    """float64, or float32 on Apple's GPUs, which do not know it."""
    return torch.float32 if device.type == "mps" else torch.float64


def _why_no_cuda() -> str:
    return "" if torch.version.cuda else f" (this torch, {torch.__version__}, is built without CUDA)"


def home_of(device: torch.device) -> torch.device:
    """Where the states of particles stand for networks on a device: there, or on the CPU if it knows no float64."""
    return CPU if device.type == "mps" else device


def name_of(device: torch.device) -> str:
    """Name of a device for records, with the model of a GPU."""
    return f"{device} ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else str(device)


def wait_for(device: torch.device) -> None:
    """Wait until a device has done all that it was given, before a clock is read."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


@contextmanager
def products_in(precision: Precision, device: torch.device) -> Iterator[None]:
    """Compute products of float32 matrices in another precision; sums and everything of float64 stay as they are.

    Args:
        precision: "float32"; "tf32", whose products keep 10 bits of a mantissa on NVIDIA GPUs and are as in float32
            elsewhere; "bfloat16", whose operands and results have 7 bits.
        device: Where they are computed.
    """
    if precision == BFLOAT16:
        with torch.autocast(device.type, torch.bfloat16):
            yield
    elif precision == TF32 and device.type == "cuda":
        with _tf32():
            yield
    else:
        yield


@contextmanager
def _tf32() -> Iterator[None]:
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


@contextmanager
def repeatable(wanted: bool) -> Iterator[None]:
    """Have GPUs give the same bits every time, if wanted, at some loss of speed; the CPU does so anyway."""
    before = torch.are_deterministic_algorithms_enabled()
    if wanted:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # which deterministic products ask for
        torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


def moved(record: Record, device: torch.device, names: Sequence[str]) -> Record:
    """A dataclass whose fields of some names, which are tensors, know `to` themselves or are None, are on a device."""
    values = {name: getattr(record, name) for name in names}
    changes: dict[str, Any] = {name: value.to(device) for name, value in values.items() if hasattr(value, "to")}
    if all(changes[name] is values[name] for name in changes):
        return record
    return replace(record, **changes)  # type: ignore[type-var]
