"""The list of the kinds of stages: one file each, and nothing else that knows them all."""

import ast
import inspect
from importlib import import_module
from pathlib import Path

import pytest

from cconv.study.declared.stage import Stage, kind_of
from cconv.study.records.found import Parts
from cconv.study.stages import STAGES

STAGE_FILES = Path(__file__).parents[3] / "cconv" / "study" / "stages"
KINDS = {kind_of(stage) for stage in STAGES}


@pytest.mark.parametrize("stage", STAGES, ids=kind_of)
def test_a_kind_stands_alone_in_the_file_named_after_it(stage):
    module = import_module(f"cconv.study.stages.{kind_of(stage)}")
    defined = [each for each in vars(module).values() if isinstance(each, type) and each.__module__ == module.__name__]
    assert [each for each in defined if issubclass(each, Stage)] == [stage]


@pytest.mark.parametrize("path", sorted(STAGE_FILES.glob("*.py")), ids=lambda path: path.stem)
def test_every_stage_that_a_file_defines_is_in_the_list_unless_it_is_abstract(path):
    module = import_module(f"cconv.study.stages.{path.stem}")
    stages = [each for each in vars(module).values() if isinstance(each, type) and issubclass(each, Stage)]
    assert {stage for stage in stages if not stage.__abstractmethods__} <= set(STAGES)


def test_kinds_are_distinct():
    assert len(KINDS) == len(STAGES)


@pytest.mark.parametrize("stage", STAGES, ids=kind_of)
def test_a_stage_uses_known_kinds(stage):
    assert {*stage.uses, *stage.space_kinds} <= KINDS
    assert stage.uses or not stage.needs_records


def parts_found_by(stage):
    """Names of the parts of the summary that the file of a stage sets."""
    calls = [node for node in ast.walk(ast.parse(inspect.getsource(inspect.getmodule(stage)))) if hasattr(node, "func")]
    results = [call for call in calls if getattr(call.func, "id", None) == "Found"]
    return {keyword.arg for result in results for keyword in result.keywords} & Parts.model_fields.keys()


def test_of_a_kind_that_sets_a_part_of_the_summary_a_study_has_one_stage():
    found = {stage: parts_found_by(stage) for stage in STAGES}
    assert set().union(*found.values()) == Parts.model_fields.keys()
    assert [stage for stage, parts in found.items() if parts and not stage.is_single] == []
