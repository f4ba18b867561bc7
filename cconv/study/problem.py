"""What all trials of a study share: the scene, the task and its samples."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import torch

from cconv.data.dataset import Dataset, open_dataset
from cconv.data.targets import Sample, iterate_samples
from cconv.data.trajectory import Scene
from cconv.errors import ConfigError
from cconv.sph.kernels import kernel_named
from cconv.study.config import DataConfig, StudyConfig
from cconv.training.field_model import FieldModel, NetworkConfig, build_field_model
from cconv.validation import PathText, check_setting, validated


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Scene, task and samples of a study.

    Attributes:
        scene: What all trajectories share.
        task: "density_rate" or "density_gradient".
        kernel: Field name of the SPH kernel.
        smoothing_length: Its h, length.
        train_samples: Frames to learn from; features and targets are standardised by them.
        valid_samples: Frames that the search compares by.
    """

    scene: Scene
    task: str
    kernel: str
    smoothing_length: float
    train_samples: list[Sample]
    valid_samples: list[Sample]

    def build_model(self, network: NetworkConfig, init_seed: int) -> FieldModel:
        """A fresh model with the initial weights of `init_seed`."""
        return build_field_model(
            network,
            self.scene,
            self.task,
            self.kernel,
            self.smoothing_length,
            self.train_samples,
            torch.Generator().manual_seed(init_seed),
        )


def open_study_data(data: DataConfig, data_seed: int) -> Dataset:
    """The data set of a study.

    Raises:
        ConfigError: If the study names none.
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
    """The study on the data at `path`.

    Raises:
        ConfigError: If study.json could not hold that path.
    """
    check_setting(PathText, path, "--data")
    return study.model_copy(update={"data": study.data.model_copy(update={"path": path})})


def study_samples(study: StudyConfig, dataset: Dataset, split: str) -> Iterable[Sample]:
    """Samples of a split with the study's task and kernel."""
    kernel = kernel_named(study.data.kernel)(smoothing_length(study.data, dataset.scene), dataset.scene.dim)
    return iterate_samples(dataset, split, study.task, kernel)


def smoothing_length(data: DataConfig, scene: Scene) -> float:
    """The study's smoothing length; the particle spacing unless set."""
    return data.smoothing_length or scene.particle_spacing


def load_problem(
    study: StudyConfig, dataset: Dataset, progress: Callable[[Iterable, str], Iterable] = lambda items, _: items
) -> Problem:
    """Training and validation samples of a study; the test split stays untouched.

    Args:
        study: The study.
        dataset: Its data.
        progress: Wraps an iterable to show progress, given a label.
    """
    problem = Problem(
        scene=dataset.scene,
        task=study.task,
        kernel=study.data.kernel,
        smoothing_length=smoothing_length(study.data, dataset.scene),
        train_samples=[],
        valid_samples=[],
    )
    samples = {split: list(progress(study_samples(study, dataset, split), split)) for split in ("train", "valid")}
    return replace(problem, train_samples=samples["train"], valid_samples=samples["valid"])


def provenance(study: StudyConfig) -> dict:
    """What a checkpoint's card says of the data, so that its errors can be computed again."""
    return {"study": study.name, "task": study.task, "data": study.data.model_dump(mode="json")}


def data_from_card(card: Mapping, path: str | None) -> DataConfig:
    """Data settings of a checkpoint's card, on another folder if `path` is given.

    Raises:
        ConfigError: If the card's settings do not fit.
    """
    settings = card.get("data", {})
    return validated(DataConfig, settings | ({"path": path} if path else {}), "card.json, data")
