"""The scene of a data set, found by its metadata; tests/contracts/test_scenes.py finds those of our own sets."""

import pytest

from cconv.scenes import scene_named
from cconv.scenes.find import find_scene

COMMON = {"solver": "SPH", "dim": 2, "free_slip": False, "write_every": 100}
PUBLISHED = {  # what LagrangeBench's metadata.json say
    "taylor_green_2d": {
        "case": "TGV", "density_evolution": False, "dx": 0.02, "dt": 4e-4, "viscosity": 0.01, "p_bg_factor": 0.0,
        "g_ext_magnitude": 0.0, "artificial_alpha": 0.0, "is_bc_trick": False, "bounds": [[0.0, 1.0], [0.0, 1.0]],
    },
    "reverse_poiseuille_2d": {
        "case": "RPF", "density_evolution": False, "dx": 0.025, "dt": 5e-4, "viscosity": 0.1, "p_bg_factor": 0.05,
        "g_ext_magnitude": 1.0, "artificial_alpha": 0.0, "is_bc_trick": False, "bounds": [[0.0, 1.0], [0.0, 2.0]],
    },
    "lid_driven_cavity_2d": {
        "case": "LDC", "density_evolution": False, "dx": 0.02, "dt": 4e-4, "viscosity": 0.01, "p_bg_factor": 0.01,
        "g_ext_magnitude": 0.0, "artificial_alpha": 0.0, "is_bc_trick": True, "bounds": [[0.0, 1.12], [0.0, 1.12]],
    },
    "dam_break_2d": {
        "case": "DB", "density_evolution": True, "dx": 0.02, "dt": 3e-4, "viscosity": 5e-5, "p_bg_factor": 0.0,
        "g_ext_magnitude": 1.0, "artificial_alpha": 0.1, "is_bc_trick": True, "bounds": [[0.0, 5.586], [0.0, 2.22]],
    },
}  # fmt: skip
DAM = COMMON | PUBLISHED["dam_break_2d"]


@pytest.mark.parametrize("name", PUBLISHED)
def test_sets_of_lagrangebench_have_the_published_scenes(name):
    assert find_scene(COMMON | PUBLISHED[name]) == (scene_named(name), "")


def test_the_box_says_the_size():
    small = scene_named("dam_break_2d", "small", particle_spacing=0.02, viscosity=5e-5, time_step=3e-4)
    found = find_scene(DAM | {"bounds": [[0.0, side] for side in small.box.upper]}).scene
    assert (found.tank, found.column) == ((2.5, 1.5), (1.0, 1.0))


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"case": "LJ"}, "no scene has the case 'LJ' in 2 dimensions"),
        ({"case": None, "dim": None}, "no scene has the case None"),
        ({"dim": 3}, "no scene has the case 'DB' in 3 dimensions"),
        ({"viscosity": None}, "`viscosity` cannot be None"),
        ({"dx": float("nan")}, "`dx` cannot be nan"),
        ({"write_every": 1.5}, "`write_every` cannot be 1.5"),
        ({"dt": 1.0}, "dam_break_2d cannot have its settings"),
        ({"p_bg_factor": 0.1}, "`p_bg_factor` is 0.1, and 0.0 in dam_break_2d"),
        ({"free_slip": True}, "`free_slip` is True, and False"),
        ({"bounds": [[0.0, 5.0], [0.0, 2.22]]}, "dam_break_2d does not have the bounds"),
        ({"dx": 1e-5, "dt": 1e-9}, "dam_break_2d would have 1.1e+11 cells of `dx`, more than 10,000,000"),
        ({"bounds": "wide"}, "dam_break_2d does not have the bounds 'wide'"),
    ],
)  # fmt: skip
def test_no_scene_is_found_for_other_settings_and_the_reason_is_said(other, reason):
    found = find_scene(DAM | other)
    assert found.scene is None
    assert reason in found.reason
