"""The table of scaling: the numbers of a row, and a run on small grids."""

import re

import pytest

from mpi_tools import scaling


def test_row_is_against_the_first_number_of_ranks():
    parts = {part: 0.0 for group in scaling.GROUPS.values() for part in group}
    common = {"cells": 64, "precision": "float64", "memory_bytes": 2e8}
    first = common | {"ranks": 2, "seconds_per_step": 0.4, "parts": parts}
    parts = parts | {"plane transforms": 0.05, "column transforms": 0.05, "products": 0.02, "transposes": 0.06}
    row = scaling.row(common | {"ranks": 8, "seconds_per_step": 0.2, "parts": parts}, first).split()
    assert row == ["64", "float64", "8", "0.2000", "2.00", "50%", "50%", "30%", "10%", "200", "MB"]


@pytest.mark.parametrize("wrong", [["--ranks", "0"], ["--cells", "many"], ["--precision", "float16"]])
def test_wrong_options_are_refused(wrong, capsys):
    with pytest.raises(SystemExit) as ended:
        scaling.main(wrong)
    assert ended.value.code == 2
    assert wrong[1] in capsys.readouterr().err


def test_small_grids_on_one_and_two_ranks(capsys):
    scaling.main(["--cells", "12", "--precision", "float32", "--steps", "1"])
    rows = re.findall(r"^ +12 +float32 +(\d) +([\d.]+) +([\d.]+) +\d+%", capsys.readouterr().out, re.MULTILINE)
    assert [row[0] for row in rows] == ["1", "2"]
    assert all(float(seconds) > 0 and float(speed_up) > 0 for _, seconds, speed_up in rows)
