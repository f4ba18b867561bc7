"""The refine stage (thesis, 4.3.1) narrows the search space by the evidence of earlier trials."""

from typing import Literal

from cconv.study.declared.stage import Stage
from cconv.study.evidence.narrowed_space import refine, write_space
from cconv.study.records.found import Found
from cconv.study.stages.session import Session


class RefineStage(Stage):
    """Narrow the space from the records of earlier stages, with a reason for each hyperparameter."""

    kind: Literal["refine"] = "refine"
    is_single = True
    uses = ("baseline", "initialization", "random")
    needs_records = True

    def run(self, session: Session, name: str) -> Found:
        """Write the narrowed space to ``stages/<name>.toml``; return the reason for each hyperparameter."""
        space, reasons = refine(session.space, session.read(name), session.study.training.updates)
        path = session.run.path / "stages" / f"{name}.toml"
        path.parent.mkdir(exist_ok=True)
        write_space(space, path)
        return Found(refined=reasons)
