"""Saved models: safetensors, config.json and card.json. Loading never unpickles anything."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from cconv.devices import CPU
from cconv.errors import ConfigError, shown
from cconv.files import read_json
from cconv.models.model import Model, ModelConfig, untrained, without_weights
from cconv.validation import Horizon, OpenModel, Real, Seed, validated

WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "card.json"
FORMAT = 3  # of config.json; in format 1 models computed in the units of their data, in 2 features had no names
LARGEST_HEADER = 2**20  # bytes of a weights file's list of contents


class _Card(OpenModel):
    """The values of a card that other code reads."""

    data: dict = {}
    data_seed: Seed = 0
    window: Horizon | None = None
    horizon: Horizon | None = None
    valid_error: Real | None = None


def save_model(model: Model, folder: Path | str, card: dict) -> None:
    """Write a model: `model.safetensors`, `config.json`, `card.json`.

    The files are written to a temporary folder, which is then renamed to `folder`; if that exists, its files are
    replaced one by one. So a reader finds a complete model even after a kill at any time.

    Args:
        model: Model to save.
        folder: Folder of the model; an earlier model is replaced.
        card: Metrics and provenance, JSON values.
    """
    folder = Path(folder)
    fresh = folder.with_name(f".{folder.name}-{os.getpid()}")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    try:
        save_file({name: tensor.cpu().contiguous() for name, tensor in model.state_dict().items()}, fresh / WEIGHTS)
        (fresh / CONFIG).write_text(json.dumps({"format": FORMAT, **model.config.model_dump(mode="json")}, indent=2))
        (fresh / CARD).write_text(json.dumps(card, indent=2, allow_nan=False))
        if not folder.exists():
            fresh.rename(folder)
            return
        for name in (CONFIG, WEIGHTS, CARD):
            os.replace(fresh / name, folder / name)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def load_model(path: Path | str, task: str | None = None, device: torch.device | str = CPU) -> Model:
    """Load a model from a folder that `save_model` wrote.

    Args:
        path: Folder with `model.safetensors` and `config.json`.
        task: Required task of the model; None allows any.
        device: Where it is to compute, whatever device it was trained on.

    Raises:
        ConfigError: If files are missing, damaged or do not belong together, or the model is for another task.
    """
    folder = Path(path)
    for name in (WEIGHTS, CONFIG):
        if not (folder / name).is_file():
            raise ConfigError(
                f"{folder}: no {name}; give a checkpoint folder, e.g. runs/<study>/finalists/<id>/seed_1/checkpoint."
            )
    config = _read_config(folder / CONFIG)
    if task is not None and config.task != task:
        raise ConfigError(
            f"{folder}: the model is for task {config.task!r}, not {shown(task)}; give a checkpoint of that task."
        )
    tensors = _read_weights(folder, config)
    model = untrained(config)
    model.load_state_dict(tensors)
    return model.eval().to(device)


def _read_config(path: Path) -> ModelConfig:
    stored = read_json(path, error=ConfigError)
    if isinstance(stored, dict):
        version = stored.pop("format", 1)
        if version != FORMAT:
            raise ConfigError(
                f"{path}: `format` is {shown(version)}, and this version reads {FORMAT}; train or fit the model again "
                "(`cconv train`, `cconv fit`)."
            )
    return validated(ModelConfig, stored, path)


def _read_weights(folder: Path, config: ModelConfig) -> dict[str, Tensor]:
    """Read the weights of a model, after a check of their names and shapes."""
    path = folder / WEIGHTS
    wanted = _shapes(config)
    try:
        with path.open("rb") as file:
            if int.from_bytes(file.read(8), "little") > LARGEST_HEADER:
                raise SafetensorError("its list of contents is too long")
        with safe_open(path, framework="pt") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118, it is no mapping
            shapes = {name: (tuple(each.get_shape()), each.get_dtype()) for name, each in slices.items()}
            wrong = sorted(name for name in wanted | shapes if wanted.get(name) != shapes.get(name))
            if wrong:
                found, want = shapes.get(wrong[0], "nothing"), wanted.get(wrong[0], "nothing")
                raise ConfigError(
                    f"{folder}: weights and {CONFIG} do not belong together ({shown(wrong[0])} is {found} in the "
                    f"weights, and {want} by the settings); copy or train the model again."
                )
            tensors = {name: file.get_tensor(name) for name in wanted}
    except (SafetensorError, OSError) as error:
        raise ConfigError(f"{path}: damaged weights ({error}); copy or train the model again.") from error
    _check_numbers(path, tensors)
    return tensors


def _shapes(config: ModelConfig) -> dict[str, tuple]:
    """Return shape and type of every tensor of a model's weights."""
    return {name: (tuple(tensor.shape), "F32") for name, tensor in without_weights(config).state_dict().items()}


def _check_numbers(path: Path, tensors: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if not torch.isfinite(tensor).all() or (name.endswith("_scale") and not (tensor > 0).all()):
            raise ConfigError(f"{path}: {name!r} holds values that are not finite, or no scale; train the model again.")


def read_card(path: Path | str) -> dict:
    """Read metrics and provenance of a saved model; empty if it has none.

    Raises:
        ConfigError: If the card is damaged.
    """
    card = Path(path) / CARD
    if not card.exists():
        return {}
    content = read_json(card, error=ConfigError)
    validated(_Card, content, card)
    return content
