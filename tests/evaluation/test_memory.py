"""Peak memory is that of each model alone, whatever came before."""

import pytest
from holders import load_holder
from systems import periodic_frame, periodic_scene

from cconv.evaluation.memory import peak_megabytes


@pytest.mark.integration
def test_peaks_are_those_of_each_model_whatever_came_before(generator, tmp_path):
    models = {name: tmp_path / name for name in ("300", "20", "100")}
    found = peak_megabytes(load_holder, models, periodic_frame(generator), periodic_scene(), 1)
    assert list(found) == list(models)
    assert all(int(name) * 0.9 < peak < int(name) + 60 for name, peak in found.items())
