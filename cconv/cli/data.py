"""`cconv data`: make, look at and convert particle data."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from cconv.cli.console import errors, plain_table, print_findings, print_json, results, show_progress
from cconv.cli.data_import import import_files
from cconv.cli.options import AsJson, DataFolder, Force, FrameDt, Mass, OutFolder, Overwrite, Spacing, open_data
from cconv.errors import ConfigError

if TYPE_CHECKING:
    from cconv.scenes.simulated_scene import SimulatedScene

# Commands import what they run inside, as torch takes seconds to load and `--help` should not.

app = typer.Typer(help="Make, look at and convert particle data.", no_args_is_help=True)
app.command("import")(import_files)


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
        typer.Option(
            help="Radius within which neighbours are counted; by default twice the particle spacing, or half of the "
            "shortest periodic axis if that is less."
        ),
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

    dataset = open_data(path, mass, particle_spacing, frame_dt, force)
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

    dataset = open_data(path, mass, particle_spacing, frame_dt, force)
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

    run(open_data(path, mass, particle_spacing, frame_dt, force), out, overwrite, show_progress)
    results.print(f"{path} as LagrangeBench HDF5: {out}", markup=False)


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
    dataset = open_data(path, mass, particle_spacing, frame_dt, force)
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


def _table(facts: dict) -> Table:
    return plain_table(facts["path"], dict(_rows(facts)))


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
