"""Relaxations that were tried so far, in ``relaxations/<finalist>.json``, so that an interrupted search continues."""

from cconv.study.records.forms import read_typed
from cconv.study.records.found import RelaxedModel
from cconv.study.records.run_folder import RunFolder, checked_id
from cconv.validation import Id

FOLDER = "relaxations"


def write_tried(run: RunFolder, finalist: Id, model: RelaxedModel) -> None:
    """Write what was tried with a finalist so far."""
    run.write(_file(finalist), model.model_dump(mode="json"))


def read_tried(run: RunFolder, finalist: Id) -> RelaxedModel | None:
    """Read what was tried with a finalist; None if nothing was.

    Raises:
        DataError: If the file is damaged, or a key or value does not fit.
    """
    path = run.path / _file(finalist)
    return read_typed(path, RelaxedModel) if path.is_file() else None


def _file(finalist: Id) -> str:
    return f"{FOLDER}/{checked_id(finalist)}.json"
