"""Arguments and options that several commands share, and what they mean."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cconv.errors import ConfigError

if TYPE_CHECKING:
    from cconv.data.dataset import Dataset

DataFolder = Annotated[
    Path,
    typer.Argument(
        metavar="PATH",
        help="Folder of the data: LagrangeBench (train.h5, valid.h5, test.h5, metadata.json) or "
        "DeepLagrangianFluids (*.msgpack.zst).",
    ),
]
OutFolder = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder to write; it appears when it is complete.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an older data set in the folder.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs instead of a table.")]
Mass = Annotated[
    float | None,
    typer.Option(help="Mass of every particle, if the data store none or wrong ones (DeepLagrangianFluids: 0.125)."),
]
Spacing = Annotated[
    float | None,
    typer.Option(help="Distance of neighbouring particles at rest; smoothing lengths scale with it."),
]
FrameDt = Annotated[
    float | None, typer.Option(help="Time between stored frames, if the data do not store it or store a wrong one.")
]
Force = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y[,Z]", help="Constant external acceleration, e.g. gravity: '0,-9.81,0'. Few data sets store it."
    ),
]


def parse_vector(text: str) -> tuple[float, ...]:
    """Numbers separated by commas.

    Raises:
        ConfigError: If one is not a number.
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"`--force` must be numbers separated by commas, such as 0,-9.81,0, got {text!r}.") from error


def given_facts(
    mass: float | None, particle_spacing: float | None, frame_dt: float | None, force: str | None
) -> dict[str, Any]:
    """What a user says of the data, by the names of `open_dataset`; None where he does not.

    Raises:
        ConfigError: If the force is no vector.
    """
    vector = None if force is None else parse_vector(force)
    return {"mass": mass, "particle_spacing": particle_spacing, "frame_dt": frame_dt, "force": vector}


def open_data(
    path: Path, mass: float | None, particle_spacing: float | None, frame_dt: float | None, force: str | None
) -> "Dataset":
    """The data set in a folder, with what a user says of it."""
    from cconv.data.dataset import open_dataset

    return open_dataset(path, **given_facts(mass, particle_spacing, frame_dt, force))


def check_new(out: Path) -> None:
    """Raise `ConfigError` if what a command is to write exists already."""
    if out.exists():
        raise ConfigError(f"{out}: exists already; give another --out.")
