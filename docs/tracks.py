"""Draws tracks.png: tracks of a simulated flow with noise, the field that a memory finds, and its standard deviation.

    .venv/bin/eddies dns tests/validation/tracks-small.toml
    .venv/bin/python docs/tracks.py runs/tracks-small/whole-16/ground_truth.h5
"""

import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
from pictures import save

import eddies
from eddies.report.figures import BAR, POSITIVE, SIGNED, colour_bar, panels, show_plane, styled

SCENE = """
[tracks]
path = "tracks.h5"
box = 6.283185307179586
filtered = false
viscosity = 0.016
[reconstruction]
method = "memory"
cells = 64
fields = ["velocity"]
particles = true
samples = 8
holdout = 0
"""
NOISE = 0.02    # standard deviation of a coordinate: a twentieth of the spacing
FRAMES = 8      # the last ones of the simulation
SHOWN = 6       # frames of a track that are drawn
THICK = 0.35    # half the thickness of the slice with tracks, about a spacing


def reconstructed(truth: Path, folder: Path) -> dict[str, np.ndarray]:
    """Reconstruct noisy positions; returns the tracks of the last frames and the plane z = pi of the last one."""
    rows, draw = eddies.read_tracks(truth), np.random.default_rng(1)
    position = rows.position + NOISE * draw.standard_normal(rows.position.shape)
    last = rows.time >= rows.times[-FRAMES]
    eddies.write_tracks(folder / "tracks.h5", rows.time[last], rows.track[last], position[last] % rows.edge,
                        edge=rows.edge)
    (folder / "scene.toml").write_text(SCENE)
    eddies.run(folder / "scene.toml", stages=["dns", "reconstruct"], output=folder / "run")
    with h5py.File(folder / "run/reconstruction.h5") as file:
        table, fields = file["particles/tracks"], file["fields/reconstructed"]
        found = {name: table[f"{name}/value"][-SHOWN:] for name in ("coordinates", "velocity")}
        return found | {name: fields[name][-1, 0, fields.attrs["cells"] // 2] for name in
                        ("velocity", "velocity_deviation")} | {"at_tracks": found["velocity"][..., 0]}


@styled
def figure(found: dict[str, np.ndarray]):
    """Tracks in a slice, u_x in its middle, and the standard deviation of u_x."""
    drawn, axes = panels(1, 3, (3.3, 3.0), right=BAR)
    place, limit = found["coordinates"], float(np.abs(found["velocity"]).max())
    near = np.flatnonzero(np.abs(place[-1, :, 2] - np.pi) < THICK)
    for row in near:
        path = place[:, row, :2]
        path[np.append(False, np.abs(np.diff(path, axis=0)).max(1) > np.pi)] = np.nan  # across a face of the box
        axes[0, 0].plot(*path.T, color="0.55", linewidth=0.7)
    dots = axes[0, 0].scatter(*place[-1, near, :2].T, c=found["at_tracks"][-1, near], s=9, cmap=SIGNED, vmin=-limit,
                              vmax=limit, zorder=2)
    planes = {"reconstructed $u_x$": (found["velocity"], (-limit, limit), SIGNED), "rms of its error": (
        found["velocity_deviation"], (0, float(found["velocity_deviation"].max())), POSITIVE)}
    images = [dots] + [show_plane(axis, *plane) for axis, plane in zip(axes[0, 1:], planes.values())]
    axes[0, 0].set(xlim=(0, 2 * np.pi), ylim=(0, 2 * np.pi), aspect=1, xticks=axes[0, 1].get_xticks(),
                   yticks=axes[0, 1].get_yticks(), xticklabels=["0", "π", "2π"], yticklabels=["0", "π", "2π"],
                   ylabel="$y$")
    for axis, image, title in zip(axes[0], images, ("tracks: $u_x$", *planes)):
        axis.set(title=title, xlabel="$x$")
        colour_bar(drawn, image, [axis], "", extend="neither")
    return drawn


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        save(Path(__file__).parent / "tracks.png", figure(reconstructed(Path(sys.argv[1]), Path(name))))
