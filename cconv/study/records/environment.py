"""The environment of a study: versions, commit, data, seeds, machine."""

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cconv.data.dataset import Dataset
from cconv.study.declared.study_file import StudyConfig

PACKAGES = ("cconv", "torch", "numpy", "scipy", "ray", "optuna", "h5py", "pandas", "pydantic")


def describe_environment(study: StudyConfig, dataset: Dataset, trials_at_once: int, device: str) -> dict:
    """Describe the provenance of a run, the content of environment.json."""
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "git_commit": _git_commit(),
        "packages": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "device": device,
        "threads": {"training": 1, "cost": study.cost.threads, "trials_at_once": trials_at_once},
        "seeds": study.seeds.model_dump(),
        "data": {"path": str(dataset.path), "sha256": dataset.fingerprint()},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """Return the commit of the package's source, with "+changes" if files differ; None outside a repository."""
    folder = Path(__file__).parent
    try:
        commit = _git(folder, "rev-parse", "HEAD")
        return commit + ("+changes" if _git(folder, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    finished = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return finished.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
