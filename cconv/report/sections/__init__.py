"""The sections of the report, one file each, in the order of the page.

To add a section, write a subclass of `Section` in a file of its own and a template of its name, and add a line to this
list.
"""

from cconv.report.sections.ablation import AblationSection
from cconv.report.sections.answer import AnswerSection
from cconv.report.sections.budget import BudgetSection
from cconv.report.sections.chart import ChartSection
from cconv.report.sections.cost import CostSection
from cconv.report.sections.finalists import FinalistsSection
from cconv.report.sections.glossary import GlossarySection
from cconv.report.sections.importance import ImportanceSection
from cconv.report.sections.learned import LearnedSection
from cconv.report.sections.provenance import ProvenanceSection
from cconv.report.sections.refined import RefinedSection
from cconv.report.sections.relaxation import RelaxationSection
from cconv.report.sections.rollouts import RolloutsSection
from cconv.report.sections.rungs import RungsSection
from cconv.report.sections.same_budget import SameBudgetSection
from cconv.report.sections.search import SearchSection
from cconv.report.sections.section import Section
from cconv.report.sections.seed_variance import SeedVarianceSection
from cconv.report.sections.space import SpaceSection
from cconv.report.sections.stability import StabilitySection
from cconv.report.sections.strategies import StrategiesSection
from cconv.report.sections.sure import SureSection

SECTIONS: tuple[Section, ...] = (
    AnswerSection(),
    ChartSection(),
    FinalistsSection(),
    SureSection(),
    BudgetSection(),
    StabilitySection(),
    RolloutsSection(),
    RelaxationSection(),
    CostSection(),
    SearchSection(),
    SameBudgetSection(),
    RungsSection(),
    StrategiesSection(),
    SpaceSection(),
    RefinedSection(),
    ImportanceSection(),
    AblationSection(),
    SeedVarianceSection(),
    LearnedSection(),
    ProvenanceSection(),
    GlossarySection(),
)
