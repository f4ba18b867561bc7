"""Sections of the report: each stands in the list, and applies to exactly the summaries that hold its data."""

import shutil
from importlib import import_module
from pathlib import Path

import pytest
from summaries import SAMPLE, changed, minimal_summary, whole_summary

import cconv.report
from cconv.report.page import render_report
from cconv.report.sections import SECTIONS
from cconv.report.sections.section import LastingSection, Section
from cconv.study.records.found import Parts
from cconv.study.records.run_folder import RunFolder

FOLDER = Path(cconv.report.__file__).parent
FILES = sorted(path.stem for path in (FOLDER / "sections").glob("*.py") if path.stem not in ("__init__", "section"))
LASTING = [section for section in SECTIONS if isinstance(section, LastingSection)]
OTHERS = [section for section in SECTIONS if section not in LASTING]


def named(section):
    return section.name


@pytest.fixture(scope="module")
def minimal():
    return minimal_summary(RunFolder(SAMPLE).summary())


@pytest.fixture(scope="module")
def whole():
    return whole_summary(RunFolder(SAMPLE).summary())


@pytest.mark.parametrize("name", FILES)
def test_every_file_holds_one_section_of_its_name_which_is_in_the_list_with_a_template(name):
    module = import_module(f"cconv.report.sections.{name}")
    defined = [each for each in vars(module).values() if isinstance(each, type) and each.__module__ == module.__name__]
    (section,) = [each for each in defined if issubclass(each, Section)]
    assert section.name == name
    assert [type(each) for each in SECTIONS].count(section) == 1
    assert (FOLDER / "templates" / "sections" / f"{name}.html.j2").is_file()


def test_the_list_and_the_templates_hold_no_more_than_the_files():
    assert sorted(map(named, SECTIONS)) == FILES
    assert sorted(path.name.split(".")[0] for path in (FOLDER / "templates" / "sections").iterdir()) == FILES


def test_titles_are_distinct():
    assert len({section.title for section in SECTIONS}) == len(SECTIONS)


@pytest.mark.parametrize("section", OTHERS, ids=named)
def test_a_section_applies_where_its_data_are_and_only_there(section, minimal, whole):
    """Data that every study has cannot be taken away."""
    assert section.applies(whole)
    assert not section.applies(None)
    nothing = getattr(minimal, section.part)
    assert section.applies(minimal) == bool(nothing)
    if not nothing:
        assert not section.applies(changed(whole, **{section.part: nothing}))
        assert section.applies(changed(minimal, **{section.part: getattr(whole, section.part)}))


@pytest.mark.parametrize("section", LASTING, ids=named)
def test_a_lasting_section_applies_to_every_run(section, minimal):
    assert section.applies(None)
    assert section.applies(minimal)


@pytest.mark.parametrize("part", Parts.model_fields)
def test_what_a_stage_finds_is_shown(part, whole):
    """Taken away alone, it changes which sections apply or belongs to one that still does."""
    templates = " ".join(path.read_text() for path in (FOLDER / "templates" / "sections").iterdir())
    code = " ".join((FOLDER / name).read_text() for name in ("tables.py", "plots.py"))
    drawn = " ".join((FOLDER / "sections" / f"{name}.py").read_text() for name in FILES)
    assert f"summary.{part}" in templates + code + drawn


@pytest.mark.integration
def test_the_page_of_a_minimal_summary_has_the_sections_that_apply(minimal, tmp_path):
    run = RunFolder(shutil.copytree(SAMPLE, tmp_path / "run"))
    run.write_summary(minimal)
    page = render_report(run)
    shown = [section.name for section in SECTIONS if section.applies(minimal)]
    assert [name for name in map(named, SECTIONS) if f'<h2 id="{name}">' in page] == shown
    assert set(shown) < set(map(named, SECTIONS))
