"""Rollouts of the finalists over test trajectories as typed values, in ``rollouts/<id>.json``.

Errors are mean squared errors of positions. Frames are counted from the start of the rollout, which is 0.
"""

from collections.abc import Iterable
from statistics import fmean

from pydantic import Field

from cconv.study.records.forms import Count, NonNegative, read_typed
from cconv.study.records.run_folder import RunFolder, checked_id
from cconv.validation import Id, Name, StrictModel

FOLDER = "rollouts"
FRAMES = "recommended"  # folder in it with the frames of the rollout that the report animates


class FlowSeries(StrictModel):
    """Measures of the fluid along a path.

    Attributes:
        e_kin: Kinetic energy without the factor 1/2, at each frame that was looked at.
        neighbors: Shares of particles with 0, 1, ... neighbours, means over these frames.
        speeds: Shares of particles by speed, in bins of equal width from 0 to the largest stored speed, means over
            these frames; the last bin has faster particles, too.
    """

    e_kin: tuple[NonNegative, ...]
    neighbors: tuple[NonNegative, ...]
    speeds: tuple[NonNegative, ...]


class RolledTrajectory(StrictModel):
    """A rollout over a whole stored trajectory.

    Attributes:
        seed: Name of the training of the model.
        trajectory: Name of the trajectory.
        stored: Number of frames that are stored after the start.
        mse: Mean squared error in each frame that was reached.
        looked_at: Numbers of the frames that all measures look at.
        sinkhorn: Sinkhorn divergences from the stored frames at some of these; of the first trajectory and the best
            training of a finalist alone, as one takes seconds.
        rollout: Measures of the rollout.
        reference: The same of the stored frames.
        beyond: First frame beyond the limit of a check of stability, by the label of its finding.
        ended: Why the rollout ended before its last frame, or "".
    """

    seed: Name
    trajectory: str
    stored: Count
    mse: tuple[NonNegative, ...] = Field(min_length=1)
    looked_at: tuple[Count, ...]
    sinkhorn: tuple[NonNegative, ...] = ()
    rollout: FlowSeries
    reference: FlowSeries
    beyond: dict[str, Count]
    ended: str

    @property
    def e_kin_error(self) -> float:
        """Mean squared error of the kinetic energy, LagrangeBench's, over the frames that were looked at."""
        pairs = zip(self.rollout.e_kin, self.reference.e_kin, strict=True)
        return fmean((found - stored) ** 2 for found, stored in pairs)


class FinalistRollouts(StrictModel):
    """The rollouts of a finalist; `lost` are those without a single frame, each named by seed and trajectory."""

    rolled: tuple[RolledTrajectory, ...]
    lost: tuple[str, ...]


def write_rollouts(run: RunFolder, name: Id, rollouts: FinalistRollouts) -> None:
    """Write the rollouts of a finalist."""
    run.write(f"{FOLDER}/{checked_id(name)}.json", rollouts.model_dump(mode="json"))


def read_rollouts(run: RunFolder, names: Iterable[Id]) -> dict[str, FinalistRollouts]:
    """Read the rollouts of finalists, by their ids.

    Raises:
        DataError: If a file is missing or damaged, or a key or value does not fit.
    """
    return {name: read_typed(run.path / FOLDER / f"{checked_id(name)}.json", FinalistRollouts) for name in names}
