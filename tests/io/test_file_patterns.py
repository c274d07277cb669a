from pathlib import Path

import pytest

from eddies.io.file_patterns import file_versions, matching_files, short_names

pytestmark = pytest.mark.mpi(1)


def test_files_of_a_series_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("frame_10.csv", "frame_9.csv", "frame_100.csv", "other.csv"):
        (tmp_path / name).touch()
    (tmp_path / "frame_11.csv").mkdir()
    assert [file.name for file in matching_files(tmp_path / "frame_*.csv")] == [
        "frame_9.csv", "frame_10.csv", "frame_100.csv"]
    assert matching_files(tmp_path / "none_*") == matching_files(tmp_path) == []
    for name in ("10", "9", "100", "11"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.csv").touch()
    assert short_names(matching_files(tmp_path / "*/a.csv")) == [
        "9/a.csv", "10/a.csv", "11/a.csv", "100/a.csv"]


def test_other_characters_of_a_path_stand_for_themselves(tmp_path):
    (tmp_path / "run[1]?.csv").touch()
    (tmp_path / "run1a.csv").touch()
    assert matching_files(f"{tmp_path}/run[1]?.csv") == [tmp_path / "run[1]?.csv"]


def test_versions_change_with_the_content(tmp_path):
    file = tmp_path / "a.1"
    file.write_text("1")
    before = file_versions(Path(tmp_path) / "a.*")
    file.write_text("12")
    assert len(before) == 1 and file_versions(tmp_path / "a.*") != before
