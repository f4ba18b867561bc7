"""`cconv import`: weights that others have published, as a checkpoint of ours."""

import hashlib
from pathlib import Path
from typing import Annotated

import typer

from cconv.cli.console import print_json, results
from cconv.cli.options import AsJson, check_new


def import_weights(
    weights: Annotated[
        Path, typer.Argument(metavar="FILE", help="Published weights of the ConvNet: pretrained_model_weights.h5.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Checkpoint to write; it must not exist yet.")],
    as_json: AsJson = False,
) -> None:
    """Turn the published weights of the ConvNet (Ummenhofer et al., ICLR 2020) into a checkpoint.

    It is a model of the task position_correction for scenes in three dimensions whose wall points have normals
    (`cconv rollout DIR --data FOLDER`). Nothing that the file holds is run.
    """
    from cconv.models.checkpoint import save_model
    from cconv.models.imported import published_conv_net

    check_new(out)
    model = published_conv_net(weights)
    facts = {
        "stage": "imported",
        "source": "Ummenhofer et al., Lagrangian Fluid Simulation with Continuous Convolutions (ICLR 2020)",
        "weights": weights.name,
        "weights_sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "num_parameters": model.num_parameters,
    }
    save_model(model, out, facts)
    if as_json:
        print_json(facts | {"checkpoint": str(out)})
        return
    results.print(f"Imported {model.num_parameters:,} parameters. Checkpoint: {out}", soft_wrap=True)
