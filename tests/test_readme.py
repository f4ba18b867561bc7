"""The code blocks of the README run as they stand, on a small data set and a fitted model."""

import re
from pathlib import Path

import cconv
from cconv.models.checkpoint import save_model

README = Path(__file__).parents[1] / "README.md"
CHECKPOINT = "runs/dpi_density_rate/finalists/baseline/seed_1/checkpoint"


def test_the_code_blocks_of_the_readme_run(flow_folder, tmp_path):
    save_model(cconv.fit_closed_form(cconv.open_dataset(flow_folder)), tmp_path / "model", {})
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 4
    code = "\n".join(blocks)
    for placeholder, path in {"FOLDER": flow_folder, CHECKPOINT: tmp_path / "model"}.items():
        assert f'"{placeholder}"' in code
        code = code.replace(f'"{placeholder}"', repr(str(path)))
    names = {}
    exec(compile(code, str(README), "exec"), names)
    assert names["features"].shape == (1000, 16)
    assert names["output"].shape == (1000, 1)
    assert names["frame"].positions.shape[1] == 2
