"""One trial: a configuration trained, evaluated and recorded. Knows nothing of Ray."""

import math
from collections.abc import Callable, Iterator, Mapping

from cconv.study.config import TrainingConfig
from cconv.study.problem import Problem
from cconv.study.records import TrialFolder
from cconv.study.space import configure
from cconv.training.checkpoint import save_model
from cconv.training.field_model import NetworkConfig
from cconv.training.loop import TrainingState, train


def run_trial(
    problem: Problem,
    parameters: Mapping,
    network: NetworkConfig,
    training: TrainingConfig,
    folder: TrialFolder,
    *,
    stage: str,
    init_seed: int,
    data_seed: int,
    provenance: Mapping,
    on_update: Callable[[TrainingState], None] = lambda state: None,
) -> Iterator[dict]:
    """Train one configuration; yields an entry at every evaluation, after it is on disk.

    The checkpoint of the folder is the model of the best validation error so far; on Ctrl-C before the first evaluation
    it is the model as it stands. A loss that is not finite ends the trial with an entry whose ``diverged`` is true.

    Args:
        problem: Scene, task and samples.
        parameters: Hyperparameters that replace those of `network` and `training`.
        network: The study's network settings.
        training: The study's training settings.
        folder: Where config.json, log.jsonl and checkpoint/ are written.
        stage: Stage that the trial belongs to.
        init_seed: Seed of the initial weights.
        data_seed: Seed of the batch order.
        provenance: Where the data come from, for the checkpoint's card.
        on_update: Sees the state after every update.
    """
    network, training = configure(parameters, network, training)
    model = problem.build_model(network, init_seed)
    config = {
        "stage": stage,
        "parameters": dict(parameters),
        "network": network.model_dump(),
        "training": training.model_dump(),
        "init_seed": init_seed,
        "data_seed": data_seed,
        "num_parameters": model.num_parameters,
    }
    folder.start(config)
    card = config | dict(provenance)
    best = math.inf
    states = train(
        model,
        problem.train_samples,
        problem.valid_samples,
        updates=training.updates,
        evaluate_every=training.evaluate_every,
        batch_size=training.batch_size,
        learning_rate=training.learning_rate,
        schedule=training.schedule,
        data_seed=data_seed,
        cache_bytes=training.cache_megabytes * 2**20,
    )
    try:
        for state in states:
            on_update(state)
            if state.valid_normalized_mse is None and not state.diverged:
                continue
            entry = _entry(state)
            folder.append(entry)
            if not state.diverged and state.valid_normalized_mse < best:
                best = state.valid_normalized_mse
                save_model(model, folder.checkpoint, card | {"valid_normalized_mse": best, "updates": state.updates})
            yield entry
    except KeyboardInterrupt:
        if not folder.checkpoint.exists():
            save_model(model, folder.checkpoint, card | {"valid_normalized_mse": None})
        raise


def _entry(state: TrainingState) -> dict:
    return {
        "updates": state.updates,
        "train_loss": _finite(state.train_loss),
        "valid_normalized_mse": _finite(state.valid_normalized_mse),
        "learning_rate": state.learning_rate,
        "seconds": state.seconds,
        "diverged": state.diverged,
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
