"""Private folders of runs: gone when the run ends or was killed, never those of a run that lives, and short."""

import tempfile

import pytest

from cconv.errors import ConfigError
from cconv.study.running.private_folder import PREFIX, private_folder, remove_private_folders


def test_folders_of_killed_runs_go_and_those_in_use_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("cconv.study.running.private_folder.LONGEST_SOCKET", 1000)
    left = tmp_path / f"{PREFIX}abcdefgh"
    left.mkdir()
    other = tmp_path / f"{PREFIX}is_a_file"[: len(left.name)]
    other.touch()
    with private_folder() as first:
        remove_private_folders()
        assert (left.exists(), other.exists(), first.is_dir()) == (False, True, True)
        with private_folder() as second:
            assert first != second
        assert not second.exists()
    assert not first.exists()


def test_a_folder_that_another_run_deletes_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("cconv.study.running.private_folder.LONGEST_SOCKET", 1000)
    make, made = tempfile.mkdtemp, []

    def deleted_the_first_time(**where):
        made.append(make(**where))
        if len(made) == 1:
            remove_private_folders()
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", deleted_the_first_time)
    with private_folder() as folder:
        assert [str(folder)] == made[1:]
        assert folder.is_dir()


def test_a_long_place_for_temporary_files_is_passed_over(tmp_path, monkeypatch):
    long = tmp_path / ("x" * 100)
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    with private_folder() as folder:
        assert long not in folder.parents


def test_no_place_for_temporary_files_is_one_line_that_names_the_variable(monkeypatch):
    monkeypatch.setattr("cconv.study.running.private_folder.LONGEST_SOCKET", 20)
    with pytest.raises(ConfigError, match="bytes too long.*set TMPDIR") as caught, private_folder():
        pass
    assert "\n" not in str(caught.value)
