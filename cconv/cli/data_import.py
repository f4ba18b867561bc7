"""`cconv data import`: particle files of other programs as a data set."""

from typing import Annotated

import typer

from cconv.cli.console import plain_table, print_json, results, show_progress
from cconv.cli.options import AsJson, Force, Mass, OutFolder, Overwrite, Spacing, parse_vector
from cconv.errors import ConfigError


def import_files(
    patterns: Annotated[
        list[str],
        typer.Argument(
            metavar="PATTERN...",
            help="Files of the fluid, in the order of the last number in their names, or patterns such as 'run/*.vtu': "
            ".vtu, .vtp, .vtk, .pvd, .vtu.series, .bgeo, .csv, .txt, .npz, .npy, .h5. Each folder is a simulation; so "
            "is each file that holds several frames.",
        ),
    ],
    out: OutFolder,
    map_: Annotated[
        str,
        typer.Option(
            "--map",
            metavar="FIELD=NAME,...",
            help="Names of arrays that are not found by usual ones, e.g. 'velocity=vel,density=rho,position=a+b'; "
            "'id=' ignores one.",
        ),
    ] = "",
    phase: Annotated[list[str] | None, typer.Option(metavar="PATTERN", help="Files of a further fluid.")] = None,
    boundary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN", help="Files of walls, obstacles or rigid bodies: one for all frames, or one a frame."
        ),
    ] = None,
    types: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER=KIND,...",
            help="Meaning of particle types: fluid, wall, moving (walls, rigid bodies), drop; e.g. '0=wall,3=fluid'.",
        ),
    ] = None,
    fluid: Annotated[
        int | None, typer.Option(help="Number of fluid particles, which come first in each file; moving walls follow.")
    ] = None,
    dt: Annotated[float | None, typer.Option(help="Time between frames, if files hold no times.")] = None,
    name_time: Annotated[
        float | None, typer.Option(metavar="UNIT", help="Times are the numbers in file names, times this unit.")
    ] = None,
    separate_frames: Annotated[
        bool,
        typer.Option(
            "--separate-frames",
            help="Make each frame a trajectory, for fields of the present frame: times may be irregular, particles may "
            "enter and leave.",
        ),
    ] = False,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Axes of the files that become x, y and z, with a minus where they are mirrored, e.g. 'x,z,-y'.",
        ),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(
            metavar="UNIT,...",
            help="Units of the files, which become metres, seconds and kilograms, e.g. 'mm,ms,g'; or factors: "
            "'length=0.05'. Other options are in the units and on the axes that come out.",
        ),
    ] = None,
    bounds: Annotated[
        str | None, typer.Option(metavar="LOW:HIGH,...", help="Box, an interval for each axis; by default around all.")
    ] = None,
    periodic: Annotated[str, typer.Option(metavar="X,Y,Z", help="Periodic axes, e.g. 'x,y'; they need --bounds.")] = "",
    gap: Annotated[int, typer.Option(help="Frames dropped between the splits of a single simulation.")] = 2,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    force: Force = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Make a data set of the particle files of any program; say what was found before anything is written.

    Simulations are split into train, valid and test; a single one is cut in time. Lengths and times keep the units of
    the files, unless --units says what these are. `cconv data check DIR` tells whether the result is plausible.
    """
    from cconv.data.folders import check_free
    from cconv.data.hdf5 import FILES
    from cconv.data.importing.conversion import Conversion, parse_axes, parse_units
    from cconv.data.importing.fields import parse_map
    from cconv.data.importing.particles import parse_types
    from cconv.data.importing.plan import plan_import
    from cconv.data.importing.settings import ImportSettings

    check_free(out.absolute(), FILES, overwrite)
    settings = ImportSettings(
        mapping=parse_map(map_) if map_ else {},
        types=None if types is None else parse_types(types),
        fluid=fluid,
        dt=dt,
        name_time=name_time,
        particle_spacing=particle_spacing,
        mass=mass,
        force=None if force is None else parse_vector(force),
        bounds=None if bounds is None else parse_bounds(bounds),
        periodic=periodic,
        conversion=Conversion(
            axes=None if axes is None else parse_axes(axes), **({} if units is None else parse_units(units))
        ),
        separate_frames=separate_frames,
        gap=gap,
    )
    plan = plan_import(patterns, settings, phases=phase or (), walls=boundary or (), progress=show_progress)
    if not as_json:
        results.print(plain_table("Found", plan.found | {"not found": "\n".join(plan.missing) or "nothing"}))
    plan.write(out, overwrite, show_progress)
    if as_json:
        print_json({"found": plan.found, "missing": list(plan.missing), "out": str(out)})
    else:
        results.print(f"Data set: {out}; next: cconv data check {out}", soft_wrap=True)


def parse_bounds(text: str) -> tuple[tuple[float, float], ...]:
    """Intervals of axes, such as "0:1,0:2".

    Raises:
        ConfigError: If one is no interval.
    """
    try:
        bounds = tuple((float(low), float(high)) for low, high in (part.split(":") for part in text.split(",")))
    except ValueError as error:
        raise ConfigError(f"`--bounds` must be LOW:HIGH,..., such as 0:1,0:2, got {text!r}.") from error
    if not all(low < high for low, high in bounds):
        raise ConfigError(f"`--bounds` must have a lower bound below the upper one on each axis, got {text!r}.")
    return bounds
