"""A training as an offline run of Weights & Biases, which `wandb sync` sends to a server."""

import os
import shutil
from importlib import import_module

from cconv.study.running.training_log import Evaluation, Training

FOLDER = "wandb"  # in that of the training


class WandbRun:
    """An offline run in the folder of a training; a run of an earlier attempt is replaced.

    Args:
        training: The training.
    """

    def __init__(self, training: Training):
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # asked for when the package is imported
        wandb = import_module("wandb")
        shutil.rmtree(training.folder / FOLDER, ignore_errors=True)
        self._run = wandb.init(
            mode="offline",
            dir=training.folder.absolute(),
            project=training.study,
            name=training.name,
            group=training.stage,
            config=dict(training.settings),
            reinit="create_new",  # whatever other runs this process has
            settings=wandb.Settings(
                silent=True, console="off", disable_git=True, disable_code=True, x_disable_stats=True
            ),
        )

    def write(self, evaluation: Evaluation) -> None:
        """Add the values of an evaluation at its number of updates."""
        self._run.log({**evaluation.values, "seconds": evaluation.seconds}, step=evaluation.updates)

    def close(self) -> None:
        """End the run."""
        self._run.finish()
