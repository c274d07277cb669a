"""Draws the figures of error against run time in results.md, from the numbers in docs/results.

    .venv/bin/python docs/fronts.py
"""

import json
from pathlib import Path

from pictures import save

from eddies.report.summary import ErrorAgainstTime, scatter
from eddies.scene.scene import load_scene
from eddies.workflows.report import Report

HERE = Path(__file__).parent
FIGURES = {"compare-small": "error-against-run-time", "compare-hit": "error-against-run-time-hit",
           "compare-coarse": "error-against-run-time-coarse"}


if __name__ == "__main__":
    for name, picture in FIGURES.items():
        rows = json.loads((HERE / f"results/{name}.json").read_text(encoding="utf-8"))["rows"]
        scene = load_scene(name)
        looks = Report(HERE, scene, dict.fromkeys({**scene.variant, **{row["name"]: None for row in rows}}, ())).looks
        table = ErrorAgainstTime(rows, "resolved", looks)
        save(HERE / f"{picture}.png", scatter(table, table.drawn))
