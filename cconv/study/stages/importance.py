"""The importance stage: how much each hyperparameter decides, from the records of random searches."""

from typing import Literal

from cconv.study.declared.stage import Stage
from cconv.study.records.found import Found
from cconv.study.stages.session import Session

SHOWN = 6  # parameters whose partial dependence is kept


class ImportanceStage(Stage):
    """Estimate how important hyperparameters are at each rung of the random searches read, with a noise floor."""

    kind: Literal["importance"] = "importance"
    uses = ("random",)
    needs_records = True

    def run(self, session: Session, name: str) -> Found:
        """Estimate the importance at every rung, and the partial dependence of the error on the strongest parameters.

        A trial that is given up counts as one that learned nothing: errors count up to where trials are given up.
        Without any rung that says enough there is no partial dependence.
        """
        from cconv.study.evidence.importance import importance_by_rung  # Optuna and scikit-learn: no reader of a study
        from cconv.study.evidence.partial_dependence import partial_dependence  # file shall wait for them

        records, space, seed = session.read(name), session.space, session.seed_of(name)
        useless = min(session.useless_error, session.study.search.give_up_above)
        importance = importance_by_rung(records, space, session.study.rungs, seed=seed, useless_error=useless)
        first = next((entry for entry in importance if entry.parameters), None)  # the fewest trials had been stopped
        if first is None:
            return Found(importance=importance)
        shares = {parameter: each.share or 0.0 for parameter, each in first.parameters.items()}
        strongest = sorted(shares, key=shares.__getitem__, reverse=True)[:SHOWN]
        dependences = [
            partial_dependence(records, space, first.updates, parameter, seed=seed, useless_error=useless)
            for parameter in strongest
        ]
        return Found(importance=importance, partial_dependence=dependences)
