"""Models as plain programs of torch (`torch.export`), which run without this package.

A program takes as plain tensors what a model takes, in the units of the data, and answers in these units. It holds the
conversion of units, the standardisation and the network, in torch's own operations; the features of the particles and
the pairs within the cutoff are the caller's.
"""

import json
import warnings
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from cconv.errors import ConfigError
from cconv.files import replacing
from cconv.models.model import Model
from cconv.neighbors import Edges
from cconv.networks.network import WallInputs
from cconv.tasks.features import CONSTANT, NORMAL, feature_unit, ordered_columns
from cconv.tasks.inputs import Units

DESCRIPTION = "description.json"  # beside the program, in its file
UNITS = ("particle spacing", "rest density", "time between frames")  # what the input `units` holds


class PlainModel(nn.Module):
    """A model as a function of plain tensors.

    Args:
        model: The model; it must not have a predictor.
    """

    def __init__(self, model: Model):
        super().__init__()
        self.model = model

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of the feature that each column of the particles' features belongs to."""
        config = self.model.config
        given = [name for name in config.fluid_features if name != CONSTANT]
        return ordered_columns(given, config.history, config.dim)

    def forward(
        self,
        features: Float[Tensor, "N C"],
        units: Float[Tensor, " 3"],
        receivers: Int[Tensor, " E"],
        senders: Int[Tensor, " E"],
        displacements: Float[Tensor, "E D"],
        wall_features: Float[Tensor, "B C_wall"] | None = None,
        wall_receivers: Int[Tensor, " F"] | None = None,
        wall_senders: Int[Tensor, " F"] | None = None,
        wall_displacements: Float[Tensor, "F D"] | None = None,
    ) -> Float[Tensor, "N C_out"]:
        """Answers (N, C_out) for all particles, in the units of the data.

        Args:
            features: Features of the particles (N, C), as `columns` names them, in the units of the data.
            units: Particle spacing, rest density and time between frames of the data, (3,).
            receivers: Particle i of each pair within the cutoff, (E,), in any order.
            senders: Its neighbour j, another particle, (E,).
            displacements: x_i - x_j, by the nearest image where an axis is periodic, in the units of the data, (E, D).
            wall_features: Normals (B, D) of the wall points, or ones (B, 1); only for a model with walls, as the rest.
            wall_receivers: Particle i of each pair with a wall point within the cutoff, (F,).
            wall_senders: The wall point (F,).
            wall_displacements: x_i - x_wall, in the units of the data, (F, D).
        """
        model, settings = self.model, self.model.settings
        scale = Units(length=units[0], density=units[1], time=units[2])
        of_columns = torch.stack([features.new_ones(()) * feature_unit(name, scale) for name in self.columns])
        flat = torch.cat([torch.ones_like(features[:, :1]), features / of_columns], dim=1)
        if settings.includes_self:
            own = torch.arange(features.shape[0], device=receivers.device)
            receivers, senders = torch.cat([receivers, own]), torch.cat([senders, own])
            displacements = torch.cat([displacements, torch.zeros_like(features[:, :1]).expand(-1, model.config.dim)])
        edges = self._edges(receivers, senders, displacements / scale.length, features, None)
        walls = None
        if not (wall_features is None or wall_receivers is None or wall_senders is None or wall_displacements is None):
            seen = self._edges(wall_receivers, wall_senders, wall_displacements / scale.length, features, wall_features)
            walls = WallInputs(wall_features, settings.geometry(seen))
        answer = model.network(model.standardized(flat), settings.geometry(edges), walls)
        return (answer * model.target_scale + model.target_mean) * model.task.unit(scale)

    def _edges(
        self, receivers: Tensor, senders: Tensor, displacements: Tensor, particles: Tensor, points: Tensor | None
    ) -> Edges:
        """Pairs in the order of their receivers; `points` send if they are others than the particles."""
        order = torch.argsort(receivers, stable=True)
        receivers, displacements = receivers[order], displacements[order]
        return Edges(
            receivers=receivers,
            senders=senders[order],
            displacements=displacements,
            distances=torch.linalg.vector_norm(displacements, dim=1),
            row_splits=torch.searchsorted(receivers, torch.arange(particles.shape[0] + 1, device=receivers.device)),
            num_senders=particles.shape[0] if points is None else points.shape[0],
            cutoff=self.model.settings.relative_cutoff,
            bipartite=points is not None,
            includes_self=points is None and self.model.settings.includes_self,
        )


def export_model(model: Model, file: Path) -> dict:
    """Write a model as a program of torch with a description of what it takes; nothing is written if that fails.

    Args:
        model: The model, on the CPU.
        file: File to write (.pt2).

    Returns:
        The description, which the file holds as `description.json`.

    Raises:
        ConfigError: If the model has a predictor, or torch cannot export its network.
        OSError: If the file cannot be written.
    """
    plain = PlainModel(model.eval())
    description = describe(plain)
    program = _traced(plain)
    with replacing(file) as part:
        torch.export.save(program, part, extra_files={DESCRIPTION: json.dumps(description, indent=2)})
    return description


def describe(plain: PlainModel) -> dict:
    """What a program takes and answers, as JSON values.

    Raises:
        ConfigError: If the model has a predictor.
    """
    config = plain.model.config
    if config.predictor is not None:
        raise ConfigError(
            "the network corrects a predictor, whose step decides which particles it sees, and no plain program can "
            "search them; use the model from Python (docs/howto/other_program.md), or export one without a predictor."
        )
    walls = config.walls
    return {
        "task": config.task,
        "answer": plain.model.task.meaning,
        "columns": list(plain.columns),
        "units": list(UNITS),
        "wall_features": None if walls is None else NORMAL if walls.vectors else CONSTANT,
        "cutoff": config.network.relative_cutoff,
        "dim": config.dim,
        "history": config.history,
        "trained_at": {"particle_spacing": config.particle_spacing, "frame_dt": config.frame_dt},
        "force_travel": config.force_travel,
        "relaxation": None if config.relaxation is None else config.relaxation.model_dump(),
        "network": config.network.model_dump(),
    }


def _traced(plain: PlainModel) -> ExportedProgram:
    """Trace a model on numbers of particles, pairs and points that differ from each other and stand for any."""
    inputs = _example(plain)
    sizes = tuple(None if name == "units" else {0: Dim.DYNAMIC} for name in inputs)
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of operations that torch itself takes apart
            return torch.export.export(plain, tuple(inputs.values()), dynamic_shapes=sizes, strict=False)
    except RuntimeError as error:  # whatever tracing refuses
        reason = str(error).splitlines()[0]
        words = plain.model.settings.in_words
        raise ConfigError(f"torch cannot export the network ({words}): {reason}; use it from Python.") from error


def _example(plain: PlainModel) -> dict[str, Tensor]:
    """Arguments of a program by name."""
    config, generator = plain.model.config, torch.Generator().manual_seed(0)

    def pairs(prefix: str, count: int, points: int) -> dict[str, Tensor]:
        return {
            f"{prefix}receivers": torch.randint(5, (count,), generator=generator),
            f"{prefix}senders": torch.randint(points, (count,), generator=generator),
            f"{prefix}displacements": torch.rand(count, config.dim, generator=generator),
        }

    inputs = {"features": torch.rand(5, len(plain.columns), generator=generator), "units": torch.ones(3)}
    inputs |= pairs("", 17, 5)
    if config.walls is not None:
        inputs["wall_features"] = torch.rand(7, config.walls.num_values(config.dim), generator=generator)
        inputs |= pairs("wall_", 11, 7)
    return inputs
