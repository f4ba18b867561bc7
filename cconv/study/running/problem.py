"""The problem that all trials of a study share: the scene, the task and its samples."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

from cconv.data.dataset import Dataset, open_dataset
from cconv.data.metadata import OVERRIDES
from cconv.data.smoothed_force import travel_deviation
from cconv.data.trajectory import Scene
from cconv.data.window import check_length
from cconv.devices import find_device
from cconv.errors import ConfigError
from cconv.evaluation.objectives import Objective, objective_of
from cconv.models.closed_form import solve_closed_form
from cconv.models.model import Model, absent_features, build_model
from cconv.study.declared.configuration import BY_INTEGRATOR, MOST_PUSHED, Configuration, TrainingConfig
from cconv.study.declared.study_file import DataConfig, StudyConfig
from cconv.tasks import task_named
from cconv.tasks.external_force import force_to_add
from cconv.tasks.features import features_in
from cconv.tasks.samples import (
    HORIZON,
    FrameSamples,
    Sample,
    StepSample,
    WindowSamples,
    learned_samples,
    rolled_samples,
)
from cconv.tasks.task import StepTask, Task, as_field, as_step
from cconv.training.augmentation import RandomWalkNoise
from cconv.training.examples import AugmentedExamples, Examples, StoredExamples
from cconv.training.losses import frame_weight
from cconv.training.unroll import Pushforward
from cconv.validation import PathText, check_setting, validated

Progress = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Scene, task and samples of a study.

    Models may differ in the history that their answers depend on. All are trained and compared at the same presents.

    Attributes:
        scene: Scene of all trajectories.
        task: Task of the models, with the longest history of any of them.
        train_samples: Frames of the training split; features and targets are standardised by them.
        valid_samples: Frames of the validation split, by whose error the search compares models.
        predictor: Model of a step that networks correct; None without one.
    """

    scene: Scene
    task: Task
    train_samples: Sequence[Sample]
    valid_samples: Sequence[Sample]
    predictor: Model | None = None

    @property
    def objective(self) -> Objective:
        """The error that models are compared by."""
        return objective_of(self.task)

    @property
    def typical_samples(self) -> Sequence[Sample]:
        """Training samples whose means and variances are those of all: all of them, or windows spread over them."""
        return self._typical(self.task)

    def task_of(self, configuration: Configuration) -> Task:
        """Task of the models of a configuration: its history, the force that its integrator adds, its predictor.

        Raises:
            ConfigError: If there is no external force to add.
        """
        task = replace(self.task, history=configuration.history)
        if configuration.external_force == BY_INTEGRATOR:
            force_to_add(self.scene)
            task = replace(as_step(task), force_travel=self._travel)
        if self.predictor is None or not configuration.with_predictor:
            return task
        return as_step(task).correcting(self.predictor)

    def _typical(self, task: Task) -> Sequence[Sample]:
        """Typical training samples of models of some task; those of each are made once."""
        if task not in self._spread:
            samples = self._training_samples(task)
            self._spread[task] = samples.spread if isinstance(samples, WindowSamples) else samples
        return self._spread[task]

    @cached_property
    def _spread(self) -> dict[Task, Sequence[Sample]]:
        return {}

    def _training_samples(self, task: Task) -> Sequence[Sample]:
        """Training samples of models of some task."""
        samples = self.train_samples
        return samples.of_task(as_step(task)) if isinstance(samples, WindowSamples) else samples

    @cached_property
    def _travel(self) -> float:
        """Standard deviation of displacements of a frame along an axis in training windows, in particle spacings."""
        windows = [sample.window for sample in self.typical_samples if isinstance(sample, StepSample)]
        moved = torch.cat([each.last_displacements(self.scene.box)[each.is_fluid] for each in windows])
        return travel_deviation(moved.std(dim=0, correction=0).tolist()) / self.scene.particle_spacing

    def valid_error(self, model: Model, geometry: Callable | None = None) -> float:
        """Compute the error of a model on the validation split; without a cache all geometries are computed anew."""
        return self.objective.error(model, self.valid_samples, geometry)

    def examples(self, training: TrainingConfig, seed: int, task: Task) -> Examples:
        """Make the examples of a training, with its noise and pushforward, of a model of some task, of `task_of`.

        Raises:
            ConfigError: If one of them is asked for where there are no windows.
        """
        samples = self._training_samples(task)
        if not training.moving:
            return StoredExamples(samples)
        if not isinstance(samples, WindowSamples):
            settings = ", ".join(f"`training.{name}` = {value:g}" for name, value in training.moving.items())
            raise ConfigError(f"{settings}: not possible for the field {self.task.name!r}, which has no windows.")
        pushforward = Pushforward(training.pushforward, training.pushforward_from)
        return AugmentedExamples(samples, RandomWalkNoise(training.noise), pushforward, seed)

    def solve_closed_form(
        self, model: Model, training: TrainingConfig, places: Iterable[int], ridge: float, seed: int
    ) -> None:
        """Fit a model of a single layer to the examples at some places, as `cconv.models.closed_form` does.

        With noise, each place gives one noisy example; the loss says how much each frame counts.
        """
        examples = self.examples(training, seed, model.task)
        drawn = (sample for place in places for sample in examples.draw([place], 0, model))
        solve_closed_form(model, drawn, ridge, weight=frame_weight(training.loss))

    @cached_property
    def present_features(self) -> tuple[str, ...]:
        """Features of the task that are not absent in this scene, such as a force where there is none."""
        absent = absent_features(self.task, self.task.features, self.typical_samples)
        return tuple(name for name in self.task.features if name not in absent)

    def features_of(self, configuration: Configuration) -> tuple[str, ...]:
        """Features that a network of a configuration is given in this scene."""
        present = tuple(name for name in configuration.features if name in self.present_features)
        return features_in(present, configuration.history)

    def build_model(self, configuration: Configuration, init_seed: int) -> Model:
        """Build an untrained model with the initial weights of `init_seed`."""
        task = self.task_of(configuration)
        model = build_model(
            configuration.network,
            task,
            self.features_of(configuration),
            self.scene,
            self._typical(task),
            torch.Generator().manual_seed(init_seed),
            configuration.training.precision,
        )
        return model if configuration.relaxation is None else model.relaxed_by(configuration.relaxation)


def open_study_data(data: DataConfig, data_seed: int) -> Dataset:
    """Open the data set of a study.

    Raises:
        ConfigError: If the study names no data.
        DataError: If it cannot be read.
    """
    if data.path is None:
        raise ConfigError("`data.path` is missing; name it in the study file or give --data FOLDER.")
    return open_dataset(
        data.path,
        mass=data.mass,
        particle_spacing=data.particle_spacing,
        frame_dt=data.frame_dt,
        force=data.force,
        split_fractions=data.split_fractions,
        gap=data.gap,
        data_seed=data_seed,
    )


def with_data_path(study: StudyConfig, path: str) -> StudyConfig:
    """Return the study with the data at `path`.

    Raises:
        ConfigError: If study.json cannot hold that path.
    """
    check_setting(PathText, path, "--data")
    return study.model_copy(update={"data": study.data.model_copy(update={"path": path})})


def with_device(study: StudyConfig, wish: str) -> StudyConfig:
    """Return the study with another wish for a device.

    Raises:
        ConfigError: If this machine does not have it.
    """
    find_device(wish)
    return study.model_copy(update={"training": study.training.model_copy(update={"device": wish})})


def device_of(study: StudyConfig) -> torch.device:
    """Find the device of a study on this machine.

    Raises:
        ConfigError: If this machine does not have it.
    """
    return find_device(study.training.device, "training.device")


def study_samples(
    study: StudyConfig, dataset: Dataset, split: str, task: Task, progress: Progress = lambda items, _: items
) -> Sequence[Sample]:
    """Make the samples of a split for a study, of the training split those to learn from.

    Args:
        study: The study.
        dataset: Its data.
        split: "train", "valid" or "test".
        task: Its task, of `study_task`.
        progress: Wraps an iterable to show progress, given a label.
    """
    if not isinstance(task, StepTask):
        return FrameSamples(dataset, split, as_field(task), progress=lambda numbers: progress(numbers, split))
    if split == "train":
        return learned_samples(dataset, split, task, further=MOST_PUSHED)
    return rolled_samples(dataset, split, task, _horizon(study))


def _horizon(study: StudyConfig) -> int:
    """Frames of the rollouts that a study compares models of a step by."""
    return study.task.horizon or HORIZON


def check_test_split(study: StudyConfig, dataset: Dataset, task: Task) -> None:
    """Check that the test split, which is read at the end alone, has frames enough for the rollouts of a step task.

    Raises:
        DataError: With the trajectory that has too few.
    """
    if isinstance(task, StepTask):
        for block in dataset.splits["test"]:
            check_length(block.trajectory, dataset.num_frames(block), task.history, _horizon(study))


def study_task(study: StudyConfig, scene: Scene, history: int | None = None) -> Task:
    """Make the task of a study for its scene.

    Args:
        study: The study.
        scene: Scene of its data.
        history: Longest history of its models; None for the study's own.
    """
    length = study.task.smoothing_length
    relative = 1.0 if length is None else length / scene.particle_spacing
    return task_named(study.task.name, study.task.kernel, relative, history or study.task.history)


def load_problem(
    study: StudyConfig, dataset: Dataset, task: Task, progress: Progress = lambda items, _: items
) -> Problem:
    """Load the training and validation samples of a study; the test split is not read.

    Args:
        study: The study.
        dataset: Its data.
        task: Its task, of `study_task`.
        progress: Wraps an iterable to show progress, given a label.
    """
    train, valid = (study_samples(study, dataset, split, task, progress) for split in ("train", "valid"))
    return Problem(scene=dataset.scene, task=task, train_samples=train, valid_samples=valid)


def provenance(study: StudyConfig, dataset: Dataset | None = None) -> dict:
    """Describe the data for the card of a checkpoint, so that its errors can be computed again.

    Args:
        study: The study.
        dataset: Its data, for their fingerprint; None if the fingerprint is added later.
    """
    fingerprint = {} if dataset is None else {"data_sha256": dataset.fingerprint()}
    asked = {"task": study.task.name, "horizon": study.task.horizon}
    return {"study": study.name, **asked, "data": study.data.model_dump(mode="json"), **fingerprint}


def open_card_data(card: Mapping, path: str | None = None, given: Mapping | None = None) -> tuple[Dataset, bool]:
    """Open the data that a checkpoint is evaluated on: those of its card, or others.

    Masses, spacing, time step and force of the card are used for the data that the model was trained on, in their
    folder or in another one with the same content. For other data they are read from these data.

    Args:
        card: Card of the checkpoint.
        path: Folder of the data; None for the card's.
        given: `mass`, `particle_spacing`, `frame_dt` and `force` from the user; None if not given.

    Returns:
        The data set, and whether the model was trained on it.

    Raises:
        ConfigError: If the card's settings do not fit, or other data lack a value that the card has for its own data.
        DataError: If the data cannot be read.
    """
    own = validated(DataConfig, card.get("data", {}), "card.json, data")
    seed = card.get("data_seed", 0)
    said = {name: value for name, value in (given or {}).items() if value is not None}
    of_card = _with(own, {"path": path or own.path} | said)
    if path is None or _same_folder(path, own.path):
        return open_study_data(of_card, seed), True
    other = open_study_data(_with(own, {**dict.fromkeys(OVERRIDES), "path": path, **said}), seed)
    if "data_sha256" in card and other.fingerprint() == card["data_sha256"]:
        return open_study_data(of_card, seed), True
    for name in ("mass", "particle_spacing"):
        _check_stored(other, name, getattr(own, name), said)
    return other, False


def _with(data: DataConfig, changes: Mapping) -> DataConfig:
    return validated(DataConfig, {**data.model_dump(), **changes}, "data")


def _same_folder(path: str, other: str | None) -> bool:
    return other is not None and Path(path).resolve() == Path(other).resolve()


def _check_stored(other: Dataset, name: str, of_card: float | None, said: Mapping) -> None:
    """Refuse data that lack a value that the card has for its own data, unless the user gives it."""
    topic = f"{OVERRIDES[name]}: "
    lines = [line.removeprefix(topic) for line in other.scene.missing if line.startswith(topic)]
    if lines and of_card is not None and name not in said:
        option = name.replace("_", "-")
        raise ConfigError(
            f"{other.path}: {topic}{lines[0]}; the model's own data have {of_card:g}, which need not hold here; give "
            f"--{option}."
        )
