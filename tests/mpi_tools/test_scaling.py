"""The table of scaling: what a row says, and a run of all of it on small grids."""

import re

import pytest

from mpi_tools import scaling


def result(ranks, seconds, parts):
    return {"cells": 64, "precision": "float64", "ranks": ranks, "seconds_per_step": seconds, "parts": parts,
            "memory_bytes": 2e8}


def test_row_is_against_the_first_number_of_ranks():
    parts = {part: 0.0 for group in scaling.GROUPS.values() for part in group}
    first = result(2, 0.4, parts)
    row = scaling.row(result(8, 0.2, parts | {"plane transforms": 0.05, "column transforms": 0.05, "products": 0.02,
                                              "transposes": 0.06}), first).split()
    assert row == ["64", "float64", "8", "0.2000", "2.00", "50%", "50%", "30%", "10%", "200", "MB"]


@pytest.mark.parametrize("wrong", [["--ranks", "0"], ["--cells", "many"], ["--precision", "float16"]])
def test_wrong_options_are_refused(wrong, capsys):
    with pytest.raises(SystemExit) as ended:
        scaling.main(wrong)
    assert ended.value.code == 2
    assert wrong[1] in capsys.readouterr().err


def test_small_grids_on_one_and_two_ranks(capsys):
    scaling.main(["--cells", "12", "--precision", "float32", "--steps", "1"])
    printed = capsys.readouterr().out
    rows = re.findall(r"^ +12 +float32 +(\d) +([\d.]+) +([\d.]+) +(\d+)%(.*)%", printed, re.MULTILINE)
    assert [row[0] for row in rows] == ["1", "2"]
    for ranks, seconds, speed_up, _, shares in rows:
        assert float(seconds) > 0 and float(speed_up) > 0
        assert len(shares.split("%")) == 3 and float(shares.split("%")[0]) > 0
