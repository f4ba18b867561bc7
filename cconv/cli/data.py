"""`cconv data`: make, look at and convert particle data."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from cconv.cli.console import errors, print_findings, print_json, results, show_progress
from cconv.errors import ConfigError

if TYPE_CHECKING:
    from cconv.data.dataset import Dataset
    from cconv.scenes.simulated_scene import SimulatedScene

# Commands import what they run inside, as torch takes seconds to load and `--help` should not.

app = typer.Typer(help="Make, look at and convert particle data.", no_args_is_help=True)

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


@app.command()
def scenes(as_json: AsJson = False) -> None:
    """List the scenes that `generate` can make, and their features: walls, forces, a free surface ..."""
    from cconv.scenes import SCENES, scene_named

    facts: list[dict] = [
        {
            "scene": name,
            "dim": scene.dim,
            "source": scene.source,
            "sizes": {size: _size_of(scene_named(name, size)) for size in scene.sizes},
            "features": scene_named(name, "small").features,
        }
        for name, scene in SCENES.items()
    ]
    if as_json:
        print_json(facts)
        return
    table = Table(title="Scenes; trajectories x frames at published size", title_justify="left")
    table.add_column("scene", no_wrap=True)
    table.add_column("size", no_wrap=True)
    table.add_column("has")
    for fact in facts:
        has = ", ".join(name.replace("_", " ") for name, present in fact["features"].items() if present)
        size = fact["sizes"]["published"]
        table.add_row(fact["scene"], f"{size['trajectories']} x {size['frames']}", has)
    results.print(table)


def _size_of(scene: "SimulatedScene") -> dict:
    return {
        "particle_spacing": scene.particle_spacing,
        "time_step": scene.time_step,
        "steps_per_frame": scene.steps_per_frame,
        "frames": scene.num_frames,
        "trajectories": scene.num_trajectories,
    }


@app.command()
def generate(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a scene; `cconv data scenes` lists them.")],
    out: OutFolder,
    size: Annotated[
        str, typer.Option(help="'published' (hours for a whole set) or 'small' (seconds, for tests and quick studies).")
    ] = "published",
    trajectories: Annotated[
        int | None,
        typer.Option(
            help="Number of simulations, split 2:1:1; a single one is cut in time. The default depends on the size."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Number of frames of each, the start included. The default depends on the size.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random starts; the same seed gives the same bytes.")] = 0,
    workers: Annotated[
        int | None, typer.Option(help="Number of simulations at the same time; by default one on each core.")
    ] = None,
    particle_spacing: Spacing = None,
    viscosity: Annotated[float | None, typer.Option(help="Kinematic viscosity.")] = None,
    time_step: Annotated[
        float | None, typer.Option(help="Time step of the solver; an error if it violates a CFL condition.")
    ] = None,
    steps_per_frame: Annotated[int | None, typer.Option(help="Number of solver steps between stored frames.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make the data of a scene with the SPH solver, e.g. to train on or to try the rest of `cconv` with.

    Finished simulations are kept in DIR.unfinished until all are done; the same command continues after a kill.
    """
    from cconv.data.generate import generate as run
    from cconv.scenes import scene_named

    settings = {"viscosity": viscosity, "steps_per_frame": steps_per_frame, "time_step": time_step}
    chosen = scene_named(scene, size, particle_spacing=particle_spacing, **settings)
    done = run(
        chosen,
        out,
        num_trajectories=trajectories,
        num_frames=frames,
        seed=seed,
        workers=workers,
        overwrite=overwrite,
        progress=show_progress,
    )
    for failure in done.failures:
        errors.print(
            f"cconv: replaced a simulation that blew up: {failure}", markup=False, highlight=False, soft_wrap=True
        )
    resumed = f", {done.reused} of them from an earlier run" if done.reused else ""
    results.print(
        f"{trajectories or chosen.num_trajectories} trajectories{resumed}: {out}", soft_wrap=True, markup=False
    )


@app.command()
def inspect(
    path: DataFolder,
    as_json: AsJson = False,
    cutoff: Annotated[
        float | None,
        typer.Option(help="Radius within which neighbours are counted; twice the particle spacing by default."),
    ] = None,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
) -> None:
    """Show what a data set holds and lacks, which defaults replace missing facts, and what is implausible.

    The command reads every trajectory, so it finds damaged files and exploded simulations. It names the frame and the
    particle of implausible data: masses of zero, frames never written, particles outside the box or at the same place,
    a spacing that does not fit, axes that particles cross although they are not periodic.
    """
    from cconv.data.inspect import inspect_dataset

    dataset = _open(path, mass, particle_spacing, frame_dt, force)
    facts = inspect_dataset(dataset, cutoff, show_progress)
    if as_json:
        print_json(facts)
    else:
        results.print(_table(facts))


@app.command()
def check(
    path: DataFolder,
    as_json: AsJson = False,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
) -> None:
    """Check whether data are plausible before anything is computed; a study does so too.

    Every trajectory is read. Suspicious data are a warning each, with trajectory, frame and particle, and what to do: a
    spacing that does not fit, particles without neighbours, jumps, clumps, particles outside the box or at the same
    place, fields that hardly differ. Data from which nothing can be learned end in one line and
    exit status 2, and no study takes them.
    """
    from cconv.data.plausibility import dataset_findings, refuse_nonsense
    from cconv.tasks import field_tasks
    from cconv.tasks.plausibility import field_findings

    dataset = _open(path, mass, particle_spacing, frame_dt, force)
    findings = dataset_findings(dataset, show_progress)
    if not any(finding.stops for finding in findings):
        findings += field_findings(dataset, field_tasks())
    if as_json:
        print_json([finding.as_dict() for finding in findings])
    refuse_nonsense(findings)
    if not as_json:
        print_findings(findings)
        results.print(f"{len(findings) or 'nothing'} suspicious found")


@app.command()
def convert(
    path: DataFolder,
    out: OutFolder,
    overwrite: Overwrite = False,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
) -> None:
    """Write a data set as LagrangeBench HDF5, with velocities, masses and wall points as extra members.

    Each split becomes a file. Values given here are stored with the data, so later commands do not need them.
    """
    from cconv.data.convert import convert as run

    run(_open(path, mass, particle_spacing, frame_dt, force), out, overwrite, show_progress)
    results.print(f"{path} as LagrangeBench HDF5: {out}", markup=False)


@app.command(name="import")
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
    the files. `cconv data check DIR` tells whether the result is plausible.
    """
    from cconv.data.folders import check_free
    from cconv.data.hdf5 import FILES
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
        separate_frames=separate_frames,
        gap=gap,
    )
    plan = plan_import(patterns, settings, phases=phase or (), walls=boundary or (), progress=show_progress)
    if not as_json:
        results.print(_plain_table("Found", plan.found | {"not found": "\n".join(plan.missing) or "nothing"}))
    plan.write(out, overwrite, show_progress)
    if as_json:
        print_json({"found": plan.found, "missing": list(plan.missing), "out": str(out)})
    else:
        results.print(f"Data set: {out}; next: cconv data check {out}", soft_wrap=True)


@app.command()
def show(
    path: DataFolder,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            help="Picture to write; by default NAME.png in the working folder, NAME being the data folder.",
        ),
    ] = None,
    split: Annotated[str, typer.Option(help="Split of the trajectory: train, valid or test.")] = "test",
    trajectory: Annotated[int, typer.Option(help="Number of the trajectory in its split, from 0.")] = 0,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="K,K,...", help="Frames of the picture, from 0, e.g. 0,50,100; by default four evenly spaced ones."
        ),
    ] = None,
    color: Annotated[
        str,
        typer.Option(
            metavar="speed|density|type",
            help="Quantity to colour by: speed; deviation of the SPH density from rest in percent (negative at a "
            "free surface and beside thin walls, where the sum lacks particles); or particle type.",
        ),
    ] = "speed",
    animate: Annotated[
        Path | None,
        typer.Option(metavar="FILE.gif|FILE.mp4", help="Animation to write, 20 frames a second; MP4 needs ffmpeg."),
    ] = None,
    every: Annotated[
        int, typer.Option(metavar="N", help="Animation and VTK files take every N-th frame of the trajectory.")
    ] = 1,
    vtk: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder of VTK files to write; in ParaView open the .vtu.series in it and choose Point Gaussian.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace older VTK files in the folder.")] = False,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
) -> None:
    """Draw frames of a trajectory side by side as PNG; animate them; export them for ParaView.

    All frames of a file share one colour scale. Outliers lie beyond its ends, which are drawn as arrows.
    """
    from cconv.data.splits import evenly_spaced
    from cconv.data.vtk import write_vtk
    from cconv.report import particles

    picture = Path(f"{path.resolve().name}.png") if out is None else out
    particles.check_picture_name(picture)
    if animate is not None:
        particles.animation_writer(animate)
    if every < 1:
        raise ConfigError(f"`--every` must be at least 1, got {every}.")
    dataset = _open(path, mass, particle_spacing, frame_dt, force)
    shown = dataset.trajectory(split, trajectory)
    chosen = evenly_spaced(len(shown), 4) if frames is None else parse_frames(frames)
    figure = particles.frames_chart(shown, dataset.scene, chosen, color, show_progress)
    sequence = range(0, len(shown), every)
    if vtk is not None:
        series = write_vtk(vtk, shown, dataset.scene, sequence, overwrite, show_progress)
        results.print(f"{len(sequence)} frames for ParaView: {series}", markup=False)
    if animate is not None:
        particles.write_animation(animate, shown, dataset.scene, sequence, color, show_progress)
        results.print(f"Animation of {len(sequence)} frames: {animate}", markup=False)
    particles.write_picture(figure, picture)
    results.print(f"Picture of {len(chosen)} frames: {picture}", markup=False)


def parse_frames(text: str) -> list[int]:
    """Frame numbers separated by commas.

    Raises:
        ConfigError: If one is not a whole number.
    """
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(
            f"`--frames` must be whole numbers separated by commas, such as 0,50,100, got {text!r}."
        ) from error


def parse_vector(text: str) -> tuple[float, ...]:
    """Numbers separated by commas.

    Raises:
        ConfigError: If one is not a number.
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"`--force` must be numbers separated by commas, such as 0,-9.81,0, got {text!r}.") from error


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


def given_facts(
    mass: float | None, particle_spacing: float | None, frame_dt: float | None, force: str | None
) -> dict[str, Any]:
    """What a user says of the data, by the names of `open_dataset`; None where he does not.

    Raises:
        ConfigError: If the force is no vector.
    """
    vector = None if force is None else parse_vector(force)
    return {"mass": mass, "particle_spacing": particle_spacing, "frame_dt": frame_dt, "force": vector}


def _open(
    path: Path, mass: float | None, particle_spacing: float | None, frame_dt: float | None, force: str | None
) -> "Dataset":
    from cconv.data.dataset import open_dataset

    return open_dataset(path, **given_facts(mass, particle_spacing, frame_dt, force))


def _table(facts: dict) -> Table:
    return _plain_table(facts["path"], dict(_rows(facts)))


def _plain_table(title: str, rows: Mapping[str, str]) -> Table:
    table = Table(title=Text(title), show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for label, text in rows.items():
        table.add_row(label, Text(text))  # names and sources come from the data: read no markup in them
    return table


def _rows(facts: dict) -> list[tuple[str, str]]:
    box, boundary, neighbors = facts["box"], facts["boundary"], facts["neighbors"]
    axes = ["x", "y", "z"][: facts["dim"]]
    periodic = [axis for axis, is_periodic in zip(axes, box["periodic"], strict=True) if is_periodic]
    bounds = (f"{axis} {low:g} to {high:g}" for axis, low, high in zip(axes, box["lower"], box["upper"], strict=True))
    normals = "with normals" if boundary["normals"] else "without normals"
    return [
        ("scene", f"{facts['name']} ({facts['format']})"),
        *((f"{split} split", _split_text(counts)) for split, counts in facts["splits"].items()),
        *((f"{kind.replace('_', ' ')} particles", _range_text(counts)) for kind, counts in facts["particles"].items()),
        ("dimensions", str(facts["dim"])),
        ("particle spacing", f"{facts['particle_spacing']:g}"),
        ("time between frames", f"{facts['frame_dt']:.6g}"),
        ("box", ", ".join(bounds)),
        ("periodic axes", ", ".join(periodic) or "none"),
        ("boundary points", f"{_range_text(boundary['points'])} {normals}" if boundary["points"]["max"] else "none"),
        ("force", _force_text(facts["force"])),
        ("velocities", facts["velocity_source"]),
        ("masses", f"{facts['mass_source']} ({_range_text(facts['mass'])})"),
        ("speed", f"mean {facts['speed']['mean']:.4g}, largest {facts['speed']['max']:.4g}"),
        (f"neighbors within {neighbors['cutoff']:g}", "mean {mean:.1f}, {min} to {max}".format(**neighbors)),
        ("missing", "\n".join(facts["missing"]) or "nothing"),
        ("suspicious", "\n".join(finding["line"] for finding in facts["findings"]) or "nothing found"),
        ("sha256", facts["sha256"]),
    ]


def _split_text(counts: dict) -> str:
    return f"{counts['trajectories']} trajectories, {counts['frames']} frames"


def _force_text(declared: dict | None) -> str:
    """Name and parameters of a force in words."""
    if declared is None:
        return "none known"
    parameters = (f"{key} {value}" for key, value in declared.items() if key != "name")
    return f"{declared['name']} ({', '.join(parameters)})"


def _range_text(values: dict) -> str:
    low, high = f"{values['min']:g}", f"{values['max']:g}"
    return low if low == high else f"{low} to {high}"
