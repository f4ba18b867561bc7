"""Models on disk: safetensors, config.json and card.json. Nothing is ever unpickled."""

import json
import os
import shutil
from pathlib import Path

from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from cconv.data.features import Standardization
from cconv.errors import ConfigError
from cconv.training.field_model import FieldConfig, FieldModel

WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "card.json"


def save_model(model: FieldModel, folder: Path | str, card: dict) -> None:
    """Write a model: `model.safetensors`, `config.json`, `card.json`.

    The files are written to a temporary folder that then takes the place of `folder`, so that a reader never finds half
    a model.

    Args:
        model: Model to save.
        folder: Folder of the model; its earlier content is replaced.
        card: Metrics and provenance, JSON values.
    """
    folder = Path(folder)
    fresh = folder.with_name(f".{folder.name}-{os.getpid()}")
    old = folder.with_name(f"{fresh.name}-old")
    for rest in (fresh, old):
        shutil.rmtree(rest, ignore_errors=True)
    fresh.mkdir(parents=True)
    try:
        save_file({name: tensor.contiguous() for name, tensor in model.state_dict().items()}, fresh / WEIGHTS)
        (fresh / CONFIG).write_text(model.config.model_dump_json(indent=2))
        (fresh / CARD).write_text(json.dumps(card, indent=2, allow_nan=False))
        if folder.exists():
            folder.rename(old)
        fresh.rename(folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def load_model(path: Path | str, task: str | None = None) -> FieldModel:
    """Model from a folder that `save_model` wrote.

    Args:
        path: Folder with `model.safetensors` and `config.json`.
        task: Task that the model must be for, or None for any.

    Raises:
        ConfigError: If files are missing, damaged or do not belong together, or the model is for another task.
    """
    folder = Path(path)
    for name in (WEIGHTS, CONFIG):
        if not (folder / name).is_file():
            raise ConfigError(
                f"{folder}: no {name}; give a checkpoint folder, e.g. runs/<study>/finalists/<id>/seed_0."
            )
    config = _read_config(folder / CONFIG)
    if task is not None and config.task != task:
        raise ConfigError(
            f"{folder}: the model is for task {config.task!r}, not {task!r}; give a checkpoint of that task."
        )
    try:
        tensors = load_file(folder / WEIGHTS)
    except (SafetensorError, OSError) as error:
        raise ConfigError(f"{folder / WEIGHTS}: damaged weights ({error}); copy or train the model again.") from error
    try:
        features, targets = (
            Standardization(tensors[f"{name}_mean"], tensors[f"{name}_scale"]) for name in ("feature", "target")
        )
        model = FieldModel(config, features, targets)
        model.load_state_dict(tensors)
    except (KeyError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{folder}: weights and {CONFIG} do not belong together ({reason}).") from error
    return model.eval()


def read_card(path: Path | str) -> dict:
    """Metrics and provenance of a saved model; empty if it has none.

    Raises:
        ConfigError: If the card is damaged.
    """
    card = Path(path) / CARD
    if not card.is_file():
        return {}
    try:
        return dict(json.loads(card.read_text()))
    except ValueError as error:
        raise ConfigError(f"{card}: not a JSON table ({error}); restore or delete it.") from error


def _read_config(path: Path) -> FieldConfig:
    try:
        return FieldConfig.model_validate_json(path.read_text())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{path}: {where or 'file'}: {first['msg']}; this is not a model of this version.") from error
