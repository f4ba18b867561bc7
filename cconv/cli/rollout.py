"""`cconv rollout`: a saved model rolled out beside the stored frames."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cconv.cli.console import errors, print_findings, print_json, results, show_progress
from cconv.cli.data import AsJson, Force, FrameDt, Mass, Spacing, given_facts
from cconv.cli.model import other_scales, scale_facts
from cconv.cli.study import DataPath
from cconv.errors import CConvError, ConfigError

if TYPE_CHECKING:
    from cconv.data.dataset import Dataset
    from cconv.data.trajectory import Scene
    from cconv.evaluation.recorded_rollout import RecordedRollout
    from cconv.models.model import ModelConfig

METRICS, ANIMATION = "metrics.json", "rollout.gif"
SOLVER_REPEATS = 3
MOST_SOLVER_WORK = 10_000_000  # particles times steps of a frame, about 20 s; published sets have up to 800,000
LONGEST_ANIMATION = 60  # frames; longer rollouts are drawn every few frames


def rollout(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            metavar="CHECKPOINT",
            help="Checkpoint folder of a model of the task acceleration, or a run folder: its recommended model.",
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
            f"and valid.h5), {METRICS} and {ANIMATION}.",
        ),
    ] = None,
    vtk: Annotated[bool, typer.Option("--vtk", help="Also write VTK files for ParaView, to DIR/vtk.")] = False,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
    as_json: AsJson = False,
) -> None:
    """Roll a saved model out by its own answers, and compare it with the stored frames.

    The model is given a window of stored frames and predicts the next frame; from that it predicts the one after, and
    so on. Ctrl-C keeps the frames so far. The exit status is 1 if the rollout diverged.
    """
    from cconv.data.plausibility import trajectory_findings
    from cconv.data.window import window_at
    from cconv.evaluation.recorded_rollout import record_rollout, rollout_facts, write_rollout
    from cconv.models.checkpoint import load_model, read_card
    from cconv.study.running.problem import open_card_data
    from cconv.tasks.task import as_step

    if vtk and out is None:
        raise ConfigError("`--vtk` writes to DIR/vtk and needs `--out DIR`.")
    if frames is not None and frames < 1:
        raise ConfigError(f"`--frames` must be at least 1, got {frames}.")
    checkpoint = _recommended(checkpoint)
    model, card = load_model(checkpoint), read_card(checkpoint)
    history = as_step(model.task).history
    given = given_facts(mass, particle_spacing, frame_dt, force)
    dataset, is_own = open_card_data(card, data, given)
    if out is not None:
        _check_free(out)
    stored = dataset.trajectory(split, trajectory)
    present = start + history - 1
    future = max(1, len(stored) - present - 1) if frames is None else frames
    recorded = record_rollout(model, window_at(stored, present, history, future), dataset.scene, show_progress)
    if not len(recorded.positions):
        raise ConfigError(f"{checkpoint}: no frame was predicted ({recorded.ended}); there is nothing to compare.")
    _warn_of_scales(dataset.scene, model.config)
    if not is_own:
        print_findings(trajectory_findings(stored, dataset.scene))
    if out is not None:
        write_rollout(out, recorded, dataset)  # first, so that what ends the rest loses no frame
    facts = {"checkpoint": str(checkpoint), "data": str(dataset.path), "split": split, "trajectory": trajectory}
    facts |= {"first_frame": start, "history": history, **rollout_facts(recorded, dataset.scene)}
    facts["solver"] = _solver_facts(dataset, recorded)
    if out is not None:
        _write_beside(out, recorded, dataset, facts, vtk)
    if as_json:
        print_json(facts)
    else:
        _print(facts, out)
    if recorded.ended is not None:
        raise typer.Exit(130 if recorded.ended == "interrupted" else 1)


def _recommended(path: Path) -> Path:
    """Return the checkpoint of the recommended model of a run folder; another folder as it is."""
    from cconv.study.records.run_folder import RunFolder

    if not (path / "summary.json").is_file():
        return path
    return path / RunFolder.open(path).summary().chosen.checkpoint


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


def _check_free(out: Path) -> None:
    from cconv.data.folders import check_free

    check_free(out, (), overwrite=False)


def _write_beside(out: Path, recorded: "RecordedRollout", dataset: "Dataset", facts: dict, vtk: bool) -> None:
    """Write the metrics, an animation and, if asked for, VTK files beside the frames of a rollout."""
    from cconv.data.vtk import write_vtk
    from cconv.evaluation.recorded_rollout import trajectories_of
    from cconv.files import write_json
    from cconv.report.particles import write_animation

    write_json(out / METRICS, facts)
    both = trajectories_of(recorded, dataset.scene)
    frames = range(0, len(both["rollout"]), math.ceil(len(both["rollout"]) / LONGEST_ANIMATION))
    if vtk:
        write_vtk(out / "vtk", both["rollout"], dataset.scene, range(len(both["rollout"])), False, show_progress)
    if dataset.scene.dim > 1:
        write_animation(out / ANIMATION, both, dataset.scene, frames, "speed", show_progress)


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
    lines.append(f"{own:.4g} ms per frame")
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
