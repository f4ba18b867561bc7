"""The kinds of stages of a study. One file holds the settings and the code of one kind.

To add a kind, write a subclass of `Stage` in a file named after it and add a line to this list.
"""

from cconv.study.declared.stage import Stage
from cconv.study.stages.ablation import AblationStage
from cconv.study.stages.adaptive import AdaptiveStage
from cconv.study.stages.baseline import BaselineStage
from cconv.study.stages.closed_form import ClosedFormStage
from cconv.study.stages.converge import ConvergeStage
from cconv.study.stages.finalists import FinalistsStage
from cconv.study.stages.importance import ImportanceStage
from cconv.study.stages.initialization import InitializationStage
from cconv.study.stages.random import RandomStage
from cconv.study.stages.reference import ReferenceStage
from cconv.study.stages.refine import RefineStage
from cconv.study.stages.relax import RelaxStage
from cconv.study.stages.select import SelectStage

STAGES: tuple[type[Stage], ...] = (
    ClosedFormStage,
    InitializationStage,
    BaselineStage,
    RandomStage,
    AdaptiveStage,
    ReferenceStage,
    RefineStage,
    ImportanceStage,
    FinalistsStage,
    AblationStage,
    ConvergeStage,
    SelectStage,
    RelaxStage,
)
