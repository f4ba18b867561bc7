"""The code blocks of the README and of docs/ run as they stand, on a small data set and a fitted model."""

import re
from pathlib import Path

from systems import untrained_step

import cconv
from cconv.models.checkpoint import save_model

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "docs" / "python.md"]
CHECKPOINT = "runs/dpi_density_rate/finalists/baseline/seed_1/checkpoint"


STEP_CHECKPOINT = "runs/rollout_taylor_green/checkpoint"


def test_the_code_blocks_run(flow_folder, steps_folder, tmp_path):
    save_model(cconv.fit_closed_form(cconv.open_dataset(flow_folder)), tmp_path / "model", {})
    save_model(untrained_step(steps_folder), tmp_path / "step", {})
    blocks = [block for page in PAGES for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)]
    assert len(blocks) == 6
    code = "\n".join(blocks)
    places = {"FOLDER": flow_folder, CHECKPOINT: tmp_path / "model"}
    places |= {"MINE": tmp_path / "mine", "VORTICES": steps_folder, STEP_CHECKPOINT: tmp_path / "step"}
    for placeholder, path in places.items():
        assert f'"{placeholder}"' in code
        code = code.replace(f'"{placeholder}"', repr(str(path)))
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert [len(cconv.open_dataset(tmp_path / "mine").trajectory(split, 0)) for split in ("train", "test")] == [40, 8]
    assert names["features"].shape == (1000, 16)
    assert names["output"].shape == (1000, 1)
    assert names["frame"].positions.shape[1] == 2
    assert [positions.shape for positions in names["path"]] == [(100, 2)] * 5


def test_every_local_link_of_the_pages_leads_somewhere():
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for page in pages:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"
