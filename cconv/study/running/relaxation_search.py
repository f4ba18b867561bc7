"""The search for a relaxation: each proposal follows from seed, number and records, so that it can be resumed."""

import math
from collections.abc import Sequence

import numpy as np

from cconv.models.relaxation import Relaxation
from cconv.study.records.found import TriedRelaxation

ALPHA, BETA, LOOPS = (0.005, 0.1), (0.0, 1.0), (1, 5)
PUBLISHED = (  # Neural SPH, table 3
    Relaxation(alpha=0.02, beta=0.0, loops=1),
    Relaxation(alpha=0.02, beta=0.2, loops=3),
    Relaxation(alpha=0.03, beta=0.0, loops=5),
)
STARTUP = 6  # random proposals before the sampler models anything, the published settings among them


def propose_relaxation(tried: Sequence[TriedRelaxation], seed: int) -> Relaxation:
    """Propose the next relaxation to try, for good flows and few loops.

    The first are published settings. Then a tree-structured Parzen estimator for both objectives proposes α on a log
    scale, β, and the number of loops (Ozaki et al., "Multiobjective tree-structured Parzen estimator", JAIR 73, 2022).

    Args:
        tried: What was tried so far, in order; those without loops do not count.
        seed: Seed of the search.
    """
    import optuna  # loads slowly

    known = [each for each in tried if each.loops]
    if len(known) < len(PUBLISHED):
        return PUBLISHED[len(known)]
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    own_seed = int(np.random.SeedSequence([seed, len(known)]).generate_state(1)[0])
    sampler = optuna.samplers.TPESampler(n_startup_trials=STARTUP, seed=own_seed)
    study = optuna.create_study(directions=["minimize", "minimize"], sampler=sampler)
    distributions = {
        "alpha": optuna.distributions.FloatDistribution(*ALPHA, log=True),
        "beta": optuna.distributions.FloatDistribution(*BETA),
        "loops": optuna.distributions.IntDistribution(*LOOPS),
    }
    for each in known:
        study.add_trial(
            optuna.trial.create_trial(
                params={"alpha": each.alpha, "beta": each.beta, "loops": each.loops},
                distributions=distributions,
                values=[math.log(each.quality), float(each.loops)],
            )
        )
    return Relaxation(**study.ask(distributions).params)
