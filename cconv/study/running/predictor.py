"""The predictor of a study: a single layer that steps first, fitted once, before any network that corrects its step."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from cconv.devices import CPU, home_of
from cconv.models.checkpoint import load_model, save_model
from cconv.models.model import Model
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.study_file import PredictorConfig, StudyConfig
from cconv.study.running.problem import Problem, device_of, provenance

Progress = Callable[[Iterable, str], Iterable]


def with_predictor(
    problem: Problem, study: StudyConfig, folder: Path | None = None, progress: Progress = lambda items, _: items
) -> Problem:
    """The problem whose networks correct the step of the study's predictor; the same if the study has none.

    Args:
        problem: Scene, task and samples.
        study: The study.
        folder: Checkpoint of the predictor: read if it is there, else written; None keeps nothing.
        progress: Wraps the frames of the fit to show progress, given a label.

    Raises:
        ConfigError: If the layer cannot be fitted, or the checkpoint is damaged.
    """
    if study.predictor is None:
        return problem
    if folder is not None and folder.exists():
        predictor = load_model(folder, study.task.name)
    else:
        predictor = _fitted(problem, study, study.predictor, progress)
        if folder is not None:
            save_model(predictor, folder, {"stage": "predictor"} | provenance(study))
    return replace(problem, predictor=predictor.requires_grad_(False))


def _fitted(problem: Problem, study: StudyConfig, asked: PredictorConfig, progress: Progress) -> Model:
    training = TrainingConfig(noise=asked.noise, loss=asked.loss)
    alone = study.configuration._replace(
        network=asked.network, training=training, with_predictor=False, relaxation=None
    )
    model = problem.build_model(alone, study.seeds.init).to(home_of(device_of(study)))
    places = progress(range(len(problem.train_samples)), "fit the predictor")
    problem.solve_closed_form(model, training, places, asked.ridge, study.seeds.data)
    return model.eval().to(CPU)  # whence it is sent to other processes
