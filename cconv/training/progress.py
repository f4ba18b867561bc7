"""The progress of a training on disk, from which it continues after a kill as if nothing had happened."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import Field
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from cconv.errors import DataError
from cconv.files import parse_json, replacing
from cconv.models.model import Model
from cconv.training.averages import begin_average
from cconv.validation import Real, StrictModel, Whole


class _Counts(StrictModel):
    updates: Whole = Field(ge=0)
    seconds: Real = Field(ge=0)
    cpu_seconds: Real = Field(0.0, ge=0)  # earlier versions did not count it


@dataclass
class Progress:
    """Optimiser and counts of a training, which the loop updates.

    Attributes:
        optimizer: Adam over the model's parameters.
        updates: Gradient updates done.
        seconds: Time spent on them, evaluations included.
        cpu_seconds: CPU time of this process spent on them, evaluations not included.
        average: The model with averages of its weights; None without them.
    """

    optimizer: torch.optim.Adam
    updates: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    average: Model | None = None


def begin(model: Model) -> Progress:
    """Return the progress of a training at its start."""
    return Progress(torch.optim.Adam(model.parameters()))


def save_progress(path: Path, model: Model, progress: Progress) -> None:
    """Write weights, their averages, Adam's moments and counts to one safetensors file, atomically."""
    counts = {name: getattr(progress, name) for name in _Counts.model_fields}
    tensors = {f"weights.{name}": value for name, value in model.state_dict().items()}
    for name, parameter in model.named_parameters():
        moments = progress.optimizer.state.get(parameter, {})
        tensors |= {f"adam.{key}.{name}": value for key, value in moments.items()}
    averages = {} if progress.average is None else progress.average.state_dict()
    tensors |= {f"average.{name}": value for name, value in averages.items()}
    with replacing(path) as part:
        stored = {name: value.cpu().contiguous() for name, value in tensors.items()}
        save_file(stored, part, {"counts": json.dumps(counts)})


def load_progress(path: Path, model: Model) -> Progress:
    """Set the model's weights to those of the file, and return its optimiser and counts.

    Raises:
        DataError: If the file is damaged or belongs to another model.
    """
    progress = begin(model)
    try:
        with safe_open(path, framework="pt") as file:
            counts = _Counts.model_validate(parse_json((file.metadata() or {})["counts"]))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no mapping
        model.load_state_dict(_below("weights.", tensors))
        if averages := _below("average.", tensors):
            progress.average = begin_average(model)
            progress.average.load_state_dict(averages)
        for name, parameter in model.named_parameters():
            if f"adam.step.{name}" in tensors:  # a parameter that no loss depends on has no moments
                moments = {key: tensors[f"adam.{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq")}
                moments |= {key: moments[key].to(parameter.device) for key in ("exp_avg", "exp_avg_sq")}
                if not all(moments[key].shape == parameter.shape for key in ("exp_avg", "exp_avg_sq")):
                    raise ValueError(f"moments of {name} have another shape")
                progress.optimizer.state[parameter] = moments
    except (SafetensorError, OSError, RuntimeError, KeyError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{path}: no progress of this training ({reason}); delete it to begin again.") from error
    progress.updates, progress.seconds, progress.cpu_seconds = counts.updates, counts.seconds, counts.cpu_seconds
    return progress


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
