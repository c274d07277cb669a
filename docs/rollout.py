"""Draws rollout.png: u_x in the plane z = pi over time, of the true tracers and of variants of a run.

    .venv/bin/python docs/rollout.py runs/hit-small paper resolved
"""

import sys
from pathlib import Path

from paper import drawn
from pictures import save

from eddies.report.rollout_figures import velocity_planes

if __name__ == "__main__":
    save(Path(__file__).parent / "rollout.png", velocity_planes(drawn(Path(sys.argv[1]), sys.argv[2:])))
