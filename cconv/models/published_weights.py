"""Weights that others have published, read from HDF5 without running anything of the file.

Source: Ummenhofer et al., "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020);
`pretrained_model_weights.h5` of its code, as Keras stores the weights of a model: a group for each layer, in it
`MyParticleNetwork/<layer>/kernel:0` and `bias:0`.
"""

from collections.abc import Mapping
from pathlib import Path

import h5py
import torch
from torch import Tensor

from cconv.data.hdf5_members import check_stored, linked
from cconv.data.limits import one_line
from cconv.errors import DataError

_MODEL = "MyParticleNetwork"  # of their code
_CONVOLUTIONS = {"conv0_obstacle": "boundary_conv"} | {
    f"conv{number}{'_fluid' if number == 0 else ''}": f"convs.{number}" for number in range(4)
}
_DENSE = {f"dense{number}{'_fluid' if number == 0 else ''}": f"dense.{number}" for number in range(4)}


def read_published(path: Path, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Read the weights of the published ConvNet.

    Links out of the file are not followed, and no member is read whose shape or type is not the expected one.

    Args:
        path: The HDF5 file.
        wanted: Tensors of the network by name, for their shapes, as of `torch.nn.Module.state_dict`.

    Returns:
        Weights by the same names, float32.

    Raises:
        DataError: If the file is missing or no HDF5 file, or a tensor is missing, damaged or of another shape.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file; give the published weights, pretrained_model_weights.h5.")
    try:
        with h5py.File(path, "r") as file:
            return {
                **{
                    f"{ours}.{name}": _read(file, layer, member, wanted[f"{ours}.{name}"].shape)
                    for layer, ours in _CONVOLUTIONS.items()
                    for member, name in (("kernel:0", "filters"), ("bias:0", "bias"))
                },
                **{
                    f"{ours}.weight": _read(file, layer, "kernel:0", wanted[f"{ours}.weight"].shape[::-1]).T
                    for layer, ours in _DENSE.items()
                },
                **{
                    f"{ours}.bias": _read(file, layer, "bias:0", wanted[f"{ours}.bias"].shape)
                    for layer, ours in _DENSE.items()
                },
            }
    except (OSError, RuntimeError, KeyError) as error:
        raise DataError(
            f"{path}: cannot be read as HDF5 ({one_line(error)}); give the published weights as .h5, no pickle."
        ) from error


def _read(file: h5py.File, layer: str, member: str, shape: tuple[int, ...]) -> Tensor:
    """Read a member of a layer after a check of what it is."""
    name = f"{layer}/{_MODEL}/{layer}/{member}"
    path = Path(file.filename)
    place, found = f"{path}: `{name}`", _member(file, name, f"{path}, {layer}")
    if not isinstance(found, h5py.Dataset):
        raise DataError(f"{place} is missing; these are not the weights of the published ConvNet.")
    if found.shape != tuple(shape) or found.dtype != "float32":
        raise DataError(
            f"{place} must have shape {tuple(shape)} and type float32, got {found.shape} and "
            f"{one_line(found.dtype, 100)}; only the published ConvNet can be imported."
        )
    if found.external or found.is_virtual:
        raise DataError(f"{place} is kept outside the file; download the file again.")
    check_stored(found, path.parent, place)
    values = torch.from_numpy(found[()])
    if not torch.isfinite(values).all():
        raise DataError(f"{place} holds NaN or infinity; download the file again.")
    return values


def _member(file: h5py.File, name: str, place: str) -> h5py.Group | h5py.Dataset | None:
    """The member at a path, None if there is none."""
    found: h5py.Group | h5py.Dataset | None = file
    for part in name.split("/"):
        found = linked(found, part, place) if isinstance(found, h5py.Group) else None
    return found
