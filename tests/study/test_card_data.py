"""What a checkpoint's card says of its data holds for these alone."""

import shutil

import pytest
from particle_files import record_frames, write_parts

from cconv.errors import ConfigError
from cconv.forces import ConstantForce
from cconv.study.running.problem import open_card_data


@pytest.fixture
def folders(tmp_path):
    """Data without masses and spacing, a copy of them, and other data; the latter with masses."""
    write_parts(tmp_path / "own")
    shutil.copytree(tmp_path / "own", tmp_path / "copy")
    write_parts(tmp_path / "other", frames=record_frames(seed=1))
    write_parts(tmp_path / "weighed", frames=record_frames(seed=2, mass=0.25))
    return tmp_path


def card_of(folder, **changes):
    data = {"path": str(folder), "mass": 0.5, "particle_spacing": 0.2, "frame_dt": 0.01, "force": [0, -1, 0]} | changes
    return {"data": data, "data_seed": 0}


def facts(dataset):
    scene = dataset.scene
    return scene.particle_spacing, float(dataset.trajectory("train", 0).masses[0]), scene.frame_dt, scene.force


def test_the_card_speaks_for_the_data_of_its_model(folders):
    card = card_of(folders / "own")
    for path in (None, str(folders / "own"), str(folders / "other" / ".." / "own")):
        dataset, is_own = open_card_data(card, path)
        assert (facts(dataset), is_own) == ((0.2, 0.5, 0.01, ConstantForce((0, -1, 0))), True)


def test_a_copy_of_the_data_is_known_by_its_content(folders):
    card = card_of(folders / "own")
    with pytest.raises(ConfigError, match="give --mass"):
        open_card_data(card, str(folders / "copy"))
    fingerprint = open_card_data(card)[0].fingerprint()
    dataset, is_own = open_card_data(card | {"data_sha256": fingerprint}, str(folders / "copy"))
    assert (facts(dataset)[:2], is_own) == ((0.2, 0.5), True)


def test_other_data_that_lack_a_value_are_refused_with_both(folders):
    card = card_of(folders / "own")
    with pytest.raises(ConfigError, match=r"other: masses: 1000 \* dx.* = 0.125.*own data have 0.5.*--mass"):
        open_card_data(card, str(folders / "other"))
    with pytest.raises(ConfigError, match=r"particle spacing: not stored; 0.05.*own data have 0.2.*--particle-spacing"):
        open_card_data(card, str(folders / "other"), {"mass": 0.3})
    dataset, is_own = open_card_data(card, str(folders / "other"), {"mass": 0.3, "particle_spacing": 0.1})
    assert (facts(dataset)[:2], is_own) == ((0.1, pytest.approx(0.3)), False)


def test_other_data_speak_for_themselves(folders):
    dataset, is_own = open_card_data(card_of(folders / "own", particle_spacing=None), str(folders / "weighed"))
    spacing, mass, frame_dt, force = facts(dataset)
    assert (spacing, mass, force, is_own) == (0.05, 0.25, None, False)
    assert frame_dt == pytest.approx(0.02, rel=1e-3)  # of the files, where the card says 0.01


def test_what_the_user_says_wins(folders):
    dataset, _ = open_card_data(card_of(folders / "own"), None, {"mass": 0.75, "force": None})
    assert facts(dataset) == (0.2, 0.75, 0.01, ConstantForce((0, -1, 0)))
