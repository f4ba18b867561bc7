"""The importance stage estimates how much each hyperparameter decides about the error, from random searches."""

from typing import Literal

from cconv.study.declared.stage import Stage
from cconv.study.records.found import Found
from cconv.study.stages.session import Session

SHOWN = 6  # hyperparameters whose partial dependence is kept


class ImportanceStage(Stage):
    """Estimate the importance of the hyperparameters at each rung of the random searches, with intervals and tests."""

    kind: Literal["importance"] = "importance"
    is_single = True
    uses = ("random",)
    needs_records = True

    def run(self, session: Session, name: str) -> Found:
        """Estimate the importance at every rung, and the partial dependence on the strongest hyperparameters.

        Errors are clipped at the error of predicting the mean, or at `give_up_above` if that is smaller. The partial
        dependence is that of the first rung with enough useful trials; without such a rung there is none.
        """
        # Optuna and scikit-learn load slowly, so only a running stage imports them.
        from cconv.study.evidence.importance import importance_by_rung
        from cconv.study.evidence.partial_dependence import partial_dependence

        records, space, seed = session.read(name), session.space, session.seed_of(name)
        useless = min(session.useless_error, session.study.search.give_up_above)
        importance = importance_by_rung(records, space, session.study.rungs, seed=seed, useless_error=useless)
        first = next(
            (entry for entry in importance if entry.parameters), None
        )  # where the fewest trials had been stopped
        if first is None:
            return Found(importance=importance)
        shares = {parameter: each.share or 0.0 for parameter, each in first.parameters.items()}
        strongest = sorted(shares, key=shares.__getitem__, reverse=True)[:SHOWN]
        dependences = [
            partial_dependence(records, space, first.updates, parameter, seed=seed, useless_error=useless)
            for parameter in strongest
        ]
        return Found(importance=importance, partial_dependence=dependences)
