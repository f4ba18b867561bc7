"""`cconv export`: a model as a plain program of torch."""

from pathlib import Path
from typing import Annotated

import typer

from cconv.cli.console import print_json, results
from cconv.cli.model import recommended_checkpoint
from cconv.cli.options import AsJson
from cconv.errors import ConfigError

SUFFIX = ".pt2"


def export(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            metavar="CHECKPOINT", help="Checkpoint folder, or a run folder: the checkpoint of its recommended model."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.pt2", help="File to write.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an older file.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a model as a plain program of torch, which runs without cconv (`torch.export.load`).

    It takes the features of the particles and the pairs within the cutoff as tensors, for any number of both, and
    answers in the units of the data; docs/howto/other_program.md shows an example. A network that corrects a predictor
    cannot be exported.
    """
    from cconv.models.checkpoint import load_model
    from cconv.models.exported import export_model

    if out.suffix != SUFFIX:
        raise ConfigError(f"`--out` must name a {SUFFIX} file, got {out}.")
    if out.is_dir() or (out.exists() and not overwrite):
        raise ConfigError(f"{out}: exists already; name another file, or give --overwrite.")
    checkpoint = recommended_checkpoint(checkpoint)
    model = load_model(checkpoint)
    try:
        description = export_model(model, out)
    except ConfigError as error:
        raise ConfigError(f"{checkpoint}: {error}") from error
    if as_json:
        print_json(description | {"checkpoint": str(checkpoint), "file": str(out)})
        return
    spacing = description["trained_at"]["particle_spacing"]
    lines = [
        f"Program: {out}",
        f"features: {', '.join(description['columns'])}",
        f"units: {', '.join(description['units'])}",
        f"pairs: within {description['cutoff']:g} particle spacings, {description['cutoff'] * spacing:g} in the "
        "training data",
    ]
    if description["wall_features"] is not None:
        lines.append(f"wall points: {description['wall_features']} each, and the pairs with them")
    lines.append(f"answer: {description['answer']}")
    for line in lines:
        results.print(line, soft_wrap=True)
