"""The relaxation that belongs to a saved model: rollouts apply it after every step."""

from typing import Annotated

from pydantic import Field

from cconv.validation import Real, StrictModel, Whole

MOST_LOOPS = 100

_Size = Annotated[Real, Field(ge=0, le=1e6)]


class Relaxation(StrictModel):
    """Settings of the SPH relaxation after every step of a rollout; see `cconv.sph.relaxation`.

    `alpha` is the size of a shift, `beta` the viscosity relative to the pressure, `loops` the number of shifts in a
    frame.
    """

    alpha: _Size
    beta: _Size = 0.0
    loops: Whole = Field(1, ge=1, le=MOST_LOOPS)
