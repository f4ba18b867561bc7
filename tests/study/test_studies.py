"""Studies with stages of the listed kinds, and what it takes to add one."""

import pickle
import subprocess
import sys
from typing import Literal

import pytest
from conftest import SMOKE

from cconv.errors import ConfigError
from cconv.study import studies
from cconv.study.declared.search_space import load_space
from cconv.study.declared.stage import Stage, kind_of
from cconv.study.pipeline import begin_study, run_study
from cconv.study.records.found import Found
from cconv.study.records.run_folder import RunFolder
from cconv.study.running.observer import Observer
from cconv.study.running.problem import with_data_path
from cconv.study.stages import STAGES
from cconv.study.studies import Study, default_stages, load_study, recorded_study, study_form
from cconv.validation import Whole, validated


class ToyStage(Stage):
    """Counts the records that it reads."""

    kind: Literal["toy"] = "toy"
    uses = ("closed_form", "random")
    weight: Whole = 1

    def run(self, session, name):
        """Return the weighted count."""
        return Found(refined={"toy": f"{self.weight * len(session.read(name))}"})


class Unwatched(Observer):
    """Sees nothing."""


def study(form=Study, **stages):
    values = {"name": "s", "task": "density_rate", "search": {"space": "space.toml"}, "stages": stages}
    return validated(form, values, "s.toml")


@pytest.fixture
def with_toy(monkeypatch):
    """The form of a study file that can ask for the toy stage too, in place of the package's own."""
    monkeypatch.setattr(studies, "Study", study_form([*STAGES, ToyStage]))
    return studies.Study


def test_the_default_stages_read_earlier_ones():
    assert study(**{name: stage.model_dump() for name, stage in default_stages().items()}).stages == default_stages()


def test_an_unknown_kind_is_refused_in_one_line_that_lists_the_known_ones():
    with pytest.raises(
        ConfigError, match=r"^s\.toml: `stages\.toy`: .*'toy'.*'closed_form', .*'select'.*\.$"
    ) as refused:
        study(toy={})
    assert "\n" not in str(refused.value)
    assert all(f"'{kind_of(stage)}'" in str(refused.value) for stage in STAGES)


def test_a_class_in_the_list_is_all_that_a_study_file_needs(with_toy):
    stages = study(with_toy, closed_form={}, toy={"weight": 3}, again={"kind": "toy", "reads": ["closed_form"]}).stages
    assert stages["toy"] == ToyStage(weight=3)
    assert stages["again"] == ToyStage(reads=("closed_form",))


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ({"toy": {"wait": 3}}, r"^s\.toml: unknown key `stages\.toy\.wait`\. Did you mean 'weight'"),
        ({"toy": {"weight": 0.5}}, r"^s\.toml: `stages\.toy\.weight`: input should be a valid integer, got 0\.5\.$"),
        ({"baseline": {}, "toy": {"reads": ["baseline"]}}, "kinds that it can use: closed_form, random"),
        ({"toy": {"kind": "random"}}, "stage `toy` must have another name"),
    ],
)
def test_a_new_kind_is_checked_like_the_others(stages, message, with_toy):
    with pytest.raises(ConfigError, match=message):
        study(with_toy, **stages)


def test_a_class_in_the_list_is_all_that_a_run_needs(with_toy, flow_folder, tmp_path):
    path = tmp_path / "toy.toml"
    path.write_text(SMOKE.read_text().split("[stages")[0] + "[stages.closed_form]\nmax_candidates = 2\n[stages.toy]\n")
    config = with_data_path(load_study(path, ["stages.toy.weight=5"]), str(flow_folder))
    run = RunFolder.create(tmp_path / "run", overwrite=False)
    begin_study(config, load_space(SMOKE.parent / config.search.space, config), run)
    assert run_study(run, Unwatched()) is None
    assert recorded_study(run) == config
    assert run.result("toy").kind == "toy"
    assert run.result("toy").refined == {"toy": f"{5 * 2}"}


def test_a_study_travels_to_other_processes():
    config = load_study(SMOKE)
    assert pickle.loads(pickle.dumps(config)) == config


@pytest.mark.parametrize(
    ("module", "unused"),
    [
        ("cconv.study.records.run_folder", {"torch", "ray", "optuna", "sklearn"}),
        ("cconv.study.studies", {"ray", "optuna", "sklearn"}),
    ],
)
def test_readers_do_not_wait_for_what_only_runs_need(module, unused):
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not unused & set(loaded.stdout.split())
