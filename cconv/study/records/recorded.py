"""What a run was declared to be: its study and its search space."""

from cconv.errors import DataError
from cconv.study.declared.domains import SearchSpace
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.run_folder import RunFolder
from cconv.validation import validated


def recorded_study(run: RunFolder) -> StudyConfig:
    """The study of a run folder.

    Raises:
        DataError: If its study.json is damaged.
    """
    values = {key: value for key, value in run.read("study.json").items() if key not in ("format", "id")}
    return validated(StudyConfig, values, run.path / "study.json", DataError)


def recorded_space(run: RunFolder) -> SearchSpace:
    """The search space of a run folder.

    Raises:
        DataError: If its space.json is damaged.
    """
    return validated(SearchSpace, run.read("space.json"), run.path / "space.json", DataError)
