"""`cconv rollout`: a saved model rolled out beside the stored frames."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cconv.cli.console import INTERRUPTED, errors, print_findings, print_json, results, show_progress
from cconv.cli.model import ModelDevice, other_scales, recommended_checkpoint, relaxation_words, scale_facts
from cconv.cli.options import AsJson, Force, FrameDt, Mass, Spacing, given_facts
from cconv.cli.study import DataPath
from cconv.errors import CConvError, ConfigError, shown

if TYPE_CHECKING:
    from cconv.data.dataset import Dataset
    from cconv.data.trajectory import Scene
    from cconv.evaluation.recorded_rollout import RecordedRollout
    from cconv.models.model import ModelConfig
    from cconv.rollout.correctors import Corrector, SPHRelaxation

METRICS = "metrics.json"
SOLVER_REPEATS = 3
MOST_SOLVER_WORK = 10_000_000  # particles times steps of a frame, about 20 s; published sets have up to 800,000
LONGEST_ANIMATION = 60  # frames; longer rollouts are drawn every few frames


def rollout(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            metavar="CHECKPOINT",
            help="Checkpoint folder of a model of a step (task acceleration or position_correction), or a run folder: "
            "its recommended model.",
        ),
    ],
    data: DataPath = None,
    split: Annotated[str, typer.Option(help="Split of the trajectory: train, valid or test.")] = "test",
    trajectory: Annotated[int, typer.Option(help="Number of the trajectory in its split, from 0.")] = 0,
    start: Annotated[int, typer.Option(help="First frame of the window that the rollout begins with, from 0.")] = 0,
    frames: Annotated[
        int | None, typer.Option(help="Number of frames to predict; by default all that are stored after the window.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder to write: the rollout in the LagrangeBench layout (test.h5; the stored frames are train.h5 "
            f"and valid.h5), {METRICS} and rollout.gif; rollout.mp4, too, if ffmpeg is there.",
        ),
    ] = None,
    relax: Annotated[
        str | None,
        typer.Option(
            metavar="ALPHA,BETA,LOOPS",
            help="Relax the particles by SPH after every frame, e.g. 0.02,0.3,3: LOOPS shifts of size ALPHA, with a "
            "viscosity of BETA times the pressure (Neural SPH). Networks whose particles clump often hold on longer. "
            "The default is what the checkpoint says.",
        ),
    ] = None,
    no_relax: Annotated[bool, typer.Option("--no-relax", help="Leave out the relaxation of the checkpoint.")] = False,
    vtk: Annotated[bool, typer.Option("--vtk", help="Also write VTK files for ParaView, to DIR/vtk.")] = False,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
    device: ModelDevice = "auto",
    as_json: AsJson = False,
) -> None:
    """Roll a saved model out by its own answers, and compare it with the stored frames.

    The model is given a window of stored frames and predicts the next frame; from that it predicts the one after, and
    so on. Frames are written as they come: what ends the rollout, such as Ctrl-C or a full disk, keeps those so far.
    The exit status is 1 if it diverged, 130 after Ctrl-C.
    """
    from cconv.data.plausibility import trajectory_findings
    from cconv.data.stored_frames import StoredFrames
    from cconv.devices import find_device, name_of
    from cconv.evaluation.recorded_rollout import asked_rollout, record_rollout, rollout_facts, write_rollout
    from cconv.models.checkpoint import load_model, read_card
    from cconv.rollout.correctors import SPHRelaxation, correctors_of
    from cconv.rollout.rollout import Diverged
    from cconv.study.running.problem import open_card_data
    from cconv.tasks.task import as_step

    if vtk and out is None:
        raise ConfigError("`--vtk` writes to DIR/vtk and needs `--out DIR`.")
    if frames is not None and frames < 1:
        raise ConfigError(f"`--frames` must be at least 1, got {frames}.")
    given_correctors = _given_correctors(relax, no_relax)
    checkpoint = recommended_checkpoint(checkpoint)
    model, card = load_model(checkpoint, device=find_device(device)), read_card(checkpoint)
    given = given_facts(mass, particle_spacing, frame_dt, force)
    dataset, is_own = open_card_data(card, data, given)
    stored = StoredFrames(dataset, split, trajectory)
    correctors = correctors_of(model) if given_correctors is None else given_correctors
    asked = asked_rollout(as_step(model.task), stored, dataset.scene, start, frames, correctors)
    try:
        if out is None:
            recorded = record_rollout(model, asked, progress=show_progress)
        else:
            recorded = write_rollout(model, asked, out, dataset.metadata, progress=show_progress)
    except Diverged as error:
        errors.print(f"cconv: {checkpoint}: {error}", style="bold red", soft_wrap=True)
        raise typer.Exit(1) from error
    _warn_of_scales(dataset.scene, model.config)
    if not is_own:
        print_findings(trajectory_findings(dataset.trajectory(split, trajectory), dataset.scene))
    facts = {"checkpoint": str(checkpoint), "data": str(dataset.path), "split": split, "trajectory": trajectory}
    facts |= {"first_frame": start, "history": len(asked.begun), **rollout_facts(recorded)}
    facts["device"] = name_of(model.device)
    facts["relaxation"] = next((asdict(each) for each in correctors if isinstance(each, SPHRelaxation)), None)
    facts["solver"] = _solver_facts(dataset, recorded)
    if out is not None:
        _write_beside(out, facts, stored.first_frame + start, vtk)
    if as_json:
        print_json(facts)
    else:
        _print(facts, out)
    if recorded.ended is not None:
        raise typer.Exit(INTERRUPTED if recorded.ended == "interrupted" else 1)


def _given_correctors(relax: str | None, no_relax: bool) -> "tuple[Corrector, ...] | None":
    """Read `--relax` and `--no-relax`; None leaves it to the checkpoint."""
    if relax is not None and no_relax:
        raise ConfigError("`--relax` and `--no-relax` exclude each other; give one of them.")
    if no_relax:
        return ()
    return None if relax is None else (_relaxation(relax),)


def _relaxation(text: str) -> "SPHRelaxation":
    """Read `--relax ALPHA,BETA,LOOPS`."""
    from cconv.rollout.correctors import SPHRelaxation

    parts = text.split(",")
    try:
        alpha, beta, loops = float(parts[0]), float(parts[1]), int(parts[2])
    except (ValueError, IndexError):
        parts = []
    if len(parts) != 3:
        raise ConfigError(f"`--relax` must be three numbers ALPHA,BETA,LOOPS, e.g. 0.02,0.3,3, got {shown(text)}.")
    return SPHRelaxation(alpha, beta, loops)


def _solver_facts(dataset: "Dataset", recorded: "RecordedRollout") -> dict:
    """Time the solver for the frame after the start, if the data say what they were made with; else say why not."""
    import torch

    from cconv.evaluation.solver_cost import measure_solver
    from cconv.scenes.find import find_scene

    scene, reason = find_scene({"dim": dataset.scene.dim, **dataset.metadata})
    if scene is None:
        return {"not_timed": reason}
    work = scene.steps_per_frame * len(recorded.start.present)
    if work > MOST_SOLVER_WORK:
        return {"not_timed": f"a frame is {work:,} steps of a particle, more than {MOST_SOLVER_WORK:,}"}
    try:
        cost = measure_solver(scene, recorded.start, threads=torch.get_num_threads(), repeats=SOLVER_REPEATS)
    except CConvError as error:
        return {"not_timed": str(error)}
    return {"milliseconds_per_frame": cost.ms_per_frame, "low": cost.ms_low, "high": cost.ms_high, "steps": cost.steps}


def _warn_of_scales(scene: "Scene", config: "ModelConfig") -> None:
    for what, found, trained in other_scales(scale_facts(scene, config)):
        errors.print(
            f"cconv: the data have a {what} of {found:g}, and the model was trained at {trained:g}; a step to the "
            "next frame holds for the spacing and the time between frames that it was trained at.",
            style="yellow",
            soft_wrap=True,
        )


def _write_beside(out: Path, facts: dict, first_frame: int, vtk: bool) -> None:
    """Write the metrics, animations and, if asked for, VTK files beside the frames of a rollout."""
    from cconv.data.dataset import open_dataset
    from cconv.data.folders import whole_file
    from cconv.data.stored_frames import StoredFrames
    from cconv.data.vtk import write_vtk
    from cconv.files import write_json
    from cconv.report.particles import animation_suffixes
    from cconv.report.rollout_animation import animate

    with whole_file(out / METRICS) as partial:
        write_json(partial, facts)
    if vtk:
        written = open_dataset(out)
        rolled = StoredFrames(written, "test", 0, first_frame)
        write_vtk(out / "vtk", rolled, written.scene, range(len(rolled)), False, show_progress)
    for suffix in animation_suffixes():
        animate(out, out / f"rollout{suffix}", LONGEST_ANIMATION, first_frame, show_progress)


def _print(facts: dict, out: Path | None) -> None:
    end = "" if facts["ended"] is None else f"; it {facts['ended']}"
    lines = [f"{facts['frames']} frames from frame {facts['first_frame'] + facts['history']} on{end}"]
    lines += [f"MSE_{n}: {value:.4g}" for n, value in facts["mse_n"].items()]
    metrics = facts["metrics"]
    energy, stored = (metrics[path]["e_kin"][-1] for path in ("rollout", "reference"))
    ratio = energy / stored if stored > 0 else math.inf
    lines.append(f"At frame {metrics['frames'][-1]} of the rollout:")
    lines.append(f"  kinetic energy ÷ that of the stored frame  {ratio:.4g}")
    lines.append(f"  drift of the momentum ÷ initial momenta    {metrics['rollout']['momentum_drift'][-1]:.4g}")
    densities = (f"{metrics[path]['rho_mae_unclamped'][-1]:.4g}" for path in ("rollout", "reference"))
    lines.append(f"  mean |ρ - 1|, rollout and stored           {', '.join(densities)}")
    lines.append(f"  Chamfer distance                           {metrics['chamfer'][-1]:.4g}")
    lines.append(f"Sinkhorn divergence at frame {metrics['sinkhorn_frames'][-1]}: {metrics['sinkhorn'][-1]:.4g}")
    own, solver = facts["milliseconds_per_frame"], facts["solver"]
    lines.append(f"{own:.4g} ms per frame{relaxation_words(facts['relaxation'], ', the relaxation included: ')}")
    if "not_timed" in solver:
        lines.append(f"The solver was not timed: {solver['not_timed']}")
    else:
        theirs = solver["milliseconds_per_frame"]
        steps = f"The solver's {solver['steps']} steps to the next frame take {theirs:.4g} ms"
        lines.append(f"{steps}, {theirs / own:.3g} times as long")
    if out is not None:
        lines.append(f"Written: {out}")
    for line in lines:
        results.print(line, soft_wrap=True)
