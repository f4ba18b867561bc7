"""What cconv needs of an installation and a machine, checked one by one; `cconv doctor` prints it."""

import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numba
import psutil
import torch
from matplotlib.animation import FFMpegWriter
from packaging.requirements import Requirement

from cconv.compiled import compile_cached
from cconv.data.limits import readable_size
from cconv.errors import CConvError
from cconv.study.running.ray_pool import private_ray

OLDEST_PYTHON, NEWEST_PYTHON = (3, 11), (3, 13)
LEAST_DISK, LEAST_TEMPORARY, LEAST_MEMORY = 2e9, 1e9, 4e9  # bytes; a study of the published sizes needs as much
EXTRAS = {  # packages that are not needed, and what they are for
    "e3nn": "the network SEGNN (pip install 'cconv[segnn]')",
    "mlflow": "trainings as runs of MLflow (pip install 'cconv[mlflow]')",
    "open3d": "the comparison with Open3D's layers (pip install 'cconv[parity]')",
    "psycopg": "Optuna studies in PostgreSQL (pip install 'cconv[cluster]')",
    "wandb": "trainings as runs of Weights & Biases (pip install 'cconv[wandb]')",
}

State = Literal["ok", "note", "warning", "problem"]


@dataclass(frozen=True)
class Checked:
    """A result of a check.

    Attributes:
        name: What was checked.
        state: "ok"; "note", something optional is absent; "warning", it works but badly; or "problem".
        found: What was found.
        advice: What to do, or "".
    """

    name: str
    state: State
    found: str
    advice: str = ""


def examine(folder: Path) -> Iterator[Checked]:
    """Check the installation and the machine, the quick checks first; a check that fails unexpectedly is a problem.

    Args:
        folder: Folder in which runs would be written.
    """
    checks: dict[str, Callable[[], Checked]] = {
        "Python": _python,
        "packages": _packages,
        "cores": _cores,
        "memory": _memory,
        "disk": lambda: _room("disk", folder, LEAST_DISK, "run in a folder on a larger disk"),
        "temporary folder": lambda: _room(
            "temporary folder", Path(tempfile.gettempdir()), LEAST_TEMPORARY, "set TMPDIR to a folder with room"
        ),
        "GPU": _gpu,
        "animations": _animations,
        "extras": _extras,
        "compiled loops": _compiled_loops,
        "Ray": _ray,
    }
    for name, check in checks.items():
        try:
            yield check()
        except Exception as error:  # whatever is broken, the other checks are still worth knowing
            yield Checked(name, "problem", f"{type(error).__name__}: {error}", "install cconv again")


def _python() -> Checked:
    found, own = platform.python_version(), tuple(map(int, platform.python_version_tuple()[:2]))
    if OLDEST_PYTHON <= own <= NEWEST_PYTHON:
        return Checked("Python", "ok", found)
    tested = f"{'.'.join(map(str, OLDEST_PYTHON))} to {'.'.join(map(str, NEWEST_PYTHON))}"
    return Checked("Python", "warning", found, f"cconv is made for Python {tested}; install it with one of these")


def _packages() -> Checked:
    """Versions of the packages that cconv is installed with, against those that it asks for."""
    wrong = []
    for line in requires("cconv") or ():
        asked = Requirement(line)
        if asked.marker is not None and not asked.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(asked.name)
        except PackageNotFoundError:
            wrong.append(f"{asked.name} is missing")
            continue
        if not asked.specifier.contains(found, prereleases=True):
            wrong.append(f"{asked.name} is {found}, not {asked.specifier}")
    if wrong:
        return Checked("packages", "problem", "; ".join(wrong), "pip install -c constraints.txt --upgrade cconv")
    return Checked("packages", "ok", f"cconv {version('cconv')}, torch {torch.__version__}, numba {numba.__version__}")


def _cores() -> Checked:
    """Cores that this process may use, and the threads of torch."""
    usable = len(psutil.Process().cpu_affinity()) if hasattr(psutil.Process, "cpu_affinity") else os.cpu_count()
    found = f"{usable} cores, {torch.get_num_threads()} threads of torch, {torch.backends.cpu.get_cpu_capability()}"
    if torch.get_num_threads() > (usable or 1):
        return Checked("cores", "warning", found, f"set OMP_NUM_THREADS to {usable}: more threads than cores are slow")
    return Checked("cores", "ok", found)


def _memory() -> Checked:
    free, total = psutil.virtual_memory().available, psutil.virtual_memory().total
    found = f"{readable_size(free)} free of {readable_size(total)}"
    if free < LEAST_MEMORY:
        return Checked("memory", "warning", found, f"free {readable_size(LEAST_MEMORY)}, or study smaller data")
    return Checked("memory", "ok", found)


def _room(name: str, folder: Path, least: float, advice: str) -> Checked:
    """Room in a folder, and whether a file can be written there."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            free = shutil.disk_usage(folder).free
    except OSError as error:
        return Checked(name, "problem", f"{folder}: {error.strerror or error}", advice)
    state: State = "ok" if free >= least else "warning"
    return Checked(name, state, f"{readable_size(free)} free in {folder}", "" if state == "ok" else advice)


def _gpu() -> Checked:
    if not torch.cuda.is_available():
        return Checked("GPU", "note", "none; everything runs on the CPU")
    names = ", ".join(torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count()))
    return Checked("GPU", "ok", f"{names}; `--device cpu` leaves it alone")


def _animations() -> Checked:
    if FFMpegWriter.isAvailable():
        return Checked("animations", "ok", "GIF and MP4")
    return Checked("animations", "note", "GIF; no MP4, as ffmpeg is not found", "install ffmpeg for MP4")


def _extras() -> Checked:
    absent = {name: purpose for name, purpose in EXTRAS.items() if find_spec(name) is None}
    found = ", ".join(name for name in EXTRAS if name not in absent) or "none"
    return Checked(
        "extras", "ok" if not absent else "note", found, "; ".join(f"{name}: {absent[name]}" for name in absent)
    )


def _compiled_loops() -> Checked:
    """A loop that numba compiles here, and where it keeps compiled code."""
    compiled = compile_cached()(_one_more)
    if compiled(1) != 2:
        return Checked("compiled loops", "problem", "numba computes wrongly", "install numba again")
    where = getattr(compiled._cache, "cache_path", None)
    if where is None or not os.access(where, os.W_OK):
        advice = "set NUMBA_CACHE_DIR to a folder that you can write to; until then each start compiles for seconds"
        return Checked("compiled loops", "warning", "work, but are not kept", advice)
    return Checked("compiled loops", "ok", f"kept in {where}")


def _one_more(number):
    return number + 1


def _ray() -> Checked:
    """A Ray that starts on this machine as studies start theirs, and ends again."""
    try:
        with private_ray(1):
            pass
    except CConvError as error:
        return Checked("Ray", "problem", str(error).rstrip("."), "until then train by `cconv study run --serial`")
    return Checked("Ray", "ok", f"{version('ray')} starts, listens on loopback only")
