"""Access to a run directory from programs and notebooks: products, numbers and figures."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eddies.errors import UserError
from eddies.pipeline import FILE_OF
from eddies.scene.rules import shortened
from eddies.scene.scene import Scene, load_scene

if TYPE_CHECKING:
    import xarray

TRAJECTORIES = {"tracers": "ground_truth/particles/tracers", "model": "rollout/particles/model",
                "truth": "rollout/particles/truth"}
FIELDS = {"filtered": "ground_truth/fields/filtered", "unfiltered": "ground_truth/fields/unfiltered",
          "final": "ground_truth/fields/final", "reconstructed": "reconstruction/fields/reconstructed",
          "model": "rollout/fields/model", "truth": "rollout/fields/truth"}
# Groups that are not stored, but computed from the rollout and its truth on access, and the axes of their arrays.
MADE = {"rollout/particles/truth": "time particle xyz",
        **dict.fromkeys(("rollout/gradients/model", "rollout/gradients/truth"), "time particle i j"),
        **dict.fromkeys(("rollout/fields/model", "rollout/fields/truth"), "time component z y x"),
        **dict.fromkeys(("rollout/spectra_of_model", "rollout/spectra_of_truth"), "time wavenumber")}
SPECTRA = {"flow": ("ground_truth/spectra", "energy"), "filtered": ("ground_truth/spectra", "filtered"),
           "model": ("rollout/spectra_of_model", "energy"), "truth": ("rollout/spectra_of_truth", "energy")}


class StoredRun:
    """The content of a run directory, read on access.

    Groups of arrays are xarray Datasets with coordinates and units, which can be pickled. The frames of a series are
    read when they are used. Access to something that is missing raises UserError.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.products:
            raise UserError(f"{self.path}: holds none of {', '.join(FILE_OF.values())}; run `eddies dns SCENE` first")

    @property
    def products(self) -> tuple[str, ...]:
        """Names of the existing products, such as "ground_truth", "kernel", "model", "rollout"."""
        return tuple(name for name, file in FILE_OF.items() if (self.path / file).is_file())

    @property
    def groups(self) -> list[str]:
        """Names for `run[...]`, such as "rollout/particles/model"."""
        from eddies.io.damage import open_to_read
        from eddies.io.datasets import groups_in
        found = []
        for product in self.products:
            with open_to_read(self.path / FILE_OF[product]) as file:
                found += [f"{product}/{group}" for group in groups_in(file)]
        return found + [name for name in MADE if name not in found and "rollout" in self.products]

    def __getitem__(self, name: str) -> xarray.Dataset:
        """Return the group of arrays with the name "PRODUCT/GROUP"."""
        from eddies.io.datasets import open_group
        product, _, group = name.partition("/")
        if product not in self.products:
            raise UserError(f"{self.path}: holds no {product}; it holds: {', '.join(self.products)}")
        return (self._made(group, MADE[name].split()) if name in MADE else
                open_group(self.path / FILE_OF[product], group))

    def _made(self, group: str, axes: list[str]) -> xarray.Dataset:
        """Return a group that is computed from the rollout, frame by frame."""
        from mpi4py import MPI

        from eddies.io.datasets import Frames, as_dataset
        from eddies.io.units import UNITS
        from eddies.workflows.rollout.measured import open_rollout
        with open_rollout(self.path, MPI.COMM_SELF) as measured:
            if group not in (groups := measured.groups()):
                raise UserError(f"{self.path}: {group} needs rollout.h5 with its ground_truth.h5, and kernel.h5 for "
                                "fields and gradients")
            times, columns = groups[group]
            samples = {column: read(0) for column, read in columns.items()}
        arrays = {"time": (times, "time", "T")}
        counted = np.arange(len(next(iter(samples.values()))))
        if axes[1] == "wavenumber":
            arrays["wavenumber"] = counted, "wavenumber", "1/L"
        elif axes[1] == "particle":
            arrays["id"] = counted, "particle", ""
        units = UNITS | {"velocity_gradient": "1/T", "energy": "L^2/T^2"}
        for column, sample in samples.items():
            read = partial(_measured, self.path.absolute(), group, column)
            arrays[column] = (Frames((len(times), *sample.shape), sample.dtype, read),
                              " ".join(axes[:1 + sample.ndim]), units.get(column, ""))
        return as_dataset(arrays, {})

    @cached_property
    def scene(self) -> Scene:
        """The scene that was run."""
        return load_scene(self.path / "scene.toml")

    def variant(self, name: str) -> StoredRun:
        """Return the run of a variant; if the scene has realisations, the run of the variant on the first one."""
        return StoredRun(variant_directory(self.path, name))

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of the report, by section and name. Warns if a product is newer than the report."""
        path = self.path / "report" / "metrics.json"
        if not path.is_file():
            raise UserError(f"{path}: no such file; run `eddies report {self.path}` first")
        from eddies.io.provenance import read_metrics
        from eddies.workflows.run_directory.work import newer_products
        if newer := [str(product.relative_to(self.path)) for product in newer_products(path)]:
            warnings.warn(f"{path}: is older than {', '.join(newer)}; run `eddies report {self.path}` again",
                          stacklevel=2)
        return read_metrics(path)

    def trajectories(self, ids: Any = None, of: str = "model", unwrapped: bool = False) -> xarray.Dataset:
        """Return position, velocity and other columns of all particles, or of the particles with the given `ids`.

        `of` is "model" or "truth" for the rollout, or "tracers" for the ground truth. If `unwrapped` is true, positions
        do not jump where a particle crosses a face of the periodic cube.
        """
        found = self[chosen(TRAJECTORIES, of)]
        try:
            found = found if ids is None else found.sel(particle=ids)
        except KeyError:
            raise UserError(f"ids = {shortened(str(np.asarray(ids).tolist()))}: must be integers from 0 to "
                            f"{found.sizes['particle'] - 1}, the particles of the run") from None
        if unwrapped:
            path = found["position"] + 2 * np.pi * found["image"]
            return found.assign(position=path.assign_attrs(found["position"].attrs))
        return found

    def field(self, name: str = "velocity", time: float | None = None, of: str = "filtered") -> xarray.DataArray:
        """Return a field on its grid, (component, z, y, x), at the stored time nearest to `time`, by default the last.

        `of` is "filtered" or "unfiltered" for the flow, "final" for the flow of a run without tracers, "reconstructed"
        for the fields of [reconstruction], or "model" or "truth" for the field that the kernel makes from the particles
        of the rollout. A scalar field has the axes (z, y, x).
        """
        return at_time(self[chosen(FIELDS, of)], name, time)

    def spectrum(self, of: str = "model", time: float | None = None) -> xarray.DataArray:
        """Return the energy spectrum at the stored time nearest to `time`, by default the last one.

        `of` is "flow" for the unfiltered flow, "filtered" for the filtered flow, or "model" or "truth" for a
        least-squares fit to the velocities of the particles of the rollout.
        """
        group, column = chosen(SPECTRA, of)
        return at_time(self[group], column, time)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """All figures of the report by name, as matplotlib figures."""
        from mpi4py import MPI

        from eddies.workflows.report import sections_of
        return {drawing.name: drawing.make() for section in sections_of(self.path, MPI.COMM_SELF)
                for drawing in section.illustrations}

    def __repr__(self) -> str:
        return f"StoredRun({str(self.path)!r}: {', '.join(self.products)})"


def open_run(path: str | Path) -> StoredRun:
    """Open a run directory and return its content."""
    return StoredRun(path)


def variant_directory(path: Path, name: str) -> Path:
    """Return the directory of a variant in the run directory `path`; if the scene has realisations, the directory of
    the variant on the first realisation. Raises SceneError if the scene has no such variant."""
    from eddies.workflows.variants import rollouts
    scene = load_scene(path / "scene.toml")
    scene.check_variants([name])
    return next(iter(rollouts(scene, path)[name]))


def chosen(table: dict[str, Any], of: str) -> Any:
    """Return the entry of a table with the name `of`. Raises UserError with the valid names if there is none."""
    if of not in table:
        raise UserError(f'of = "{of}": must be one of {", ".join(table)}')
    return table[of]


def at_time(found: xarray.Dataset, name: str, time: float | None) -> xarray.DataArray:
    """Return the variable `name` of a group at the stored time nearest to `time`, or at the last one if `time` is None.

    Raises UserError for an unknown variable, and if `time` lies before the first or after the last stored time by more
    than the longest interval between stored times.
    """
    if name not in found or name == "time":
        raise UserError(f'"{name}": no such variable; there are {", ".join(key for key in found if key != "time")}')
    times = np.asarray(found["time"])
    around = np.diff(times).max() if len(times) > 1 else np.inf
    if time is not None and not times[0] - around <= time <= times[-1] + around:
        raise UserError(f"time = {time:g}: must be between {times[0]:g} and {times[-1]:g}, the stored times")
    # `time` may be an xarray number, which numpy does not subtract from an array.
    return found[name][-1 if time is None else int(np.argmin(np.abs(times - float(time))))]


def _measured(path: Path, group: str, column: str, frames: Iterable[int]) -> Iterator[np.ndarray]:
    """Yield frames of a group that is computed from the rollout in the run directory `path`."""
    from mpi4py import MPI

    from eddies.workflows.rollout.measured import open_rollout
    with open_rollout(path, MPI.COMM_SELF) as measured:
        read = measured.groups()[group][1][column]
        for frame in frames:
            yield np.asarray(read(frame))
