"""One trial: a configuration is trained, evaluated and recorded, without Ray."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from typing import Any

from cconv.devices import find_device, name_of, repeatable
from cconv.evaluation.cost import flops_per_particle
from cconv.models.checkpoint import read_card, save_model
from cconv.models.model import Model
from cconv.study.declared.configuration import Configuration, TrainingConfig, configure
from cconv.study.records.trials import TrialFolder
from cconv.study.running.problem import Problem
from cconv.study.running.training_log import Training
from cconv.study.running.training_logs import TrainingLogs, training_logs
from cconv.training.loop import Optimization, TrainingState, train
from cconv.training.progress import Progress, begin, load_progress, save_progress
from cconv.validation import Value


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A configuration to train, with the facts for its records.

    Attributes:
        stage: Stage that the trial belongs to.
        parameters: Hyperparameters that replace those of the study.
        init_seed: Seed of the initial weights.
        data_seed: Seed of the batch order.
        provenance: Study and origin of the data, for the card of the checkpoint.
        loggers: Names of programs that its evaluations are logged for, besides TensorBoard.
    """

    stage: str
    parameters: Mapping[str, Value]
    init_seed: int
    data_seed: int
    provenance: Mapping[str, Any]
    loggers: Sequence[str] = ()


def run_trial(
    problem: Problem,
    trial: Trial,
    defaults: Configuration,
    folder: TrialFolder,
    *,
    seconds_limit: float = math.inf,
    on_update: Callable[[TrainingState], None] = lambda state: None,
) -> Iterator[dict]:
    """Train one configuration, or continue its training, and yield an entry at every evaluation.

    Before an entry is yielded, everything is on disk: the log, the same for other programs, the progress from which a
    killed training continues, and the checkpoint with the smallest validation error so far. On Ctrl-C before the first
    evaluation the checkpoint is the model at that moment. A loss that is not finite ends the trial with an entry whose
    ``diverged`` is true.

    Args:
        problem: Scene, task and samples.
        trial: The configuration and its records.
        defaults: Configuration of the study, for hyperparameters that the trial does not set.
        folder: Folder for config.json, log.jsonl, its event file, progress.safetensors and checkpoint/.
        seconds_limit: Time limit of the whole training, which ends at the first update after it.
        on_update: Function that is called with the state after every update.
    """
    configuration = configure(trial.parameters, defaults)
    training = configuration.training
    model = _on_its_device(problem.build_model(configuration, trial.init_seed), training)
    config = describe(problem, trial, model, training)
    progress = _begin_or_go_on(model, folder, config)
    card = config | dict(trial.provenance)
    best = _best_so_far(folder)
    states = train(
        model,
        problem.examples(training, trial.data_seed, model.task),
        problem.valid_error,
        Optimization(**training.model_dump(include={field.name for field in fields(Optimization)})),
        data_seed=trial.data_seed,
        cache_bytes=0 if training.moving else training.cache_megabytes * 2**20,
        progress=progress,
    )
    try:
        with repeatable(training.deterministic), _logs(trial, folder, config) as logs:
            for state in states:
                on_update(state)
                if state.valid_error is None and not state.diverged:
                    if state.seconds > seconds_limit:
                        return
                    continue
                entry = _entry(state)
                if (error := entry["valid_error"]) is not None and error < best:
                    best = error
                    save_model(state.model, folder.checkpoint, card | _spent(state) | {"valid_error": best})
                folder.append(entry)
                logs.append(entry)
                save_progress(folder.progress, model, progress)
                yield entry
    except KeyboardInterrupt:
        if not folder.checkpoint.exists():
            save_model(progress.average or model, folder.checkpoint, card | {"valid_error": None})
        raise


def _logs(trial: Trial, folder: TrialFolder, config: Mapping) -> AbstractContextManager[TrainingLogs]:
    """Logs of a training for other programs, with what its log holds already."""
    log = folder.log()
    training = Training(
        folder=folder.path,
        study=trial.provenance.get("study", folder.path.name),
        stage=trial.stage,
        settings=config,
        begun=time.time() - (log[-1]["seconds"] if log else 0.0),
    )
    return training_logs(training, log, trial.loggers)


def describe(problem: Problem, trial: Trial, model: Model, training: TrainingConfig) -> dict:
    """Describe a model and its training for config.json, before the training begins."""
    return {
        "stage": trial.stage,
        "parameters": dict(trial.parameters),
        "features": list(model.config.features),
        "window": problem.task.history,
        "network": model.settings.model_dump(),
        "training": training.model_dump(),
        "device": name_of(model.device),
        "init_seed": trial.init_seed,
        "data_seed": trial.data_seed,
        "num_parameters": model.num_parameters,
        "flops_per_particle": flops_per_particle(model, problem.valid_samples[0].inputs),
    }


def _on_its_device(model: Model, training: TrainingConfig) -> Model:
    return model.to(find_device(training.device, "training.device"))


def _begin_or_go_on(model: Model, folder: TrialFolder, config: Mapping) -> Progress:
    if not folder.progress.is_file():
        folder.start(config)
        return begin(model)
    progress = load_progress(folder.progress, model)
    folder.go_on(progress.updates)
    return progress


def _best_so_far(folder: TrialFolder) -> float:
    """Return the validation error of an earlier process's checkpoint; infinity if there is none."""
    known = read_card(folder.checkpoint).get("valid_error") if folder.progress.is_file() else None
    return math.inf if known is None else known


def _entry(state: TrainingState) -> dict:
    return {
        "updates": state.updates,
        "train_loss": _finite(state.train_loss),
        "valid_error": _finite(state.valid_error),
        "learning_rate": state.learning_rate,
        "seconds": state.seconds,
        "cpu_seconds": state.cpu_seconds,
        "diverged": state.diverged,
    }


def _spent(state: TrainingState) -> dict:
    """What a training had spent when its model was saved."""
    return {"updates": state.updates, "seconds": state.seconds, "cpu_seconds": state.cpu_seconds}


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
