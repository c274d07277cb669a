"""What stands in run directories, for people: stages, what they were made with, checkpoints, jobs and sizes."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import checkpoints_in
from eddies.io.checksums import ATTRIBUTE, find_damage, open_to_read
from eddies.io.errors import ProductError, make_again
from eddies.io.hdf5 import in_files
from eddies.io.provenance import product_provenance
from eddies.io.run_lock import find_lock
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.pipeline import STAGES, Stage
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.workflows.foreseen.storage import in_units
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import changed_settings, is_done, of_other_settings, stage_seconds
from eddies.workflows.variants import Step, steps

SCENE, PAGE = "scene.toml", Path("report") / "index.html"


def run(directory: Path, comm: Comm, verify: bool = False) -> None:
    """Print a line for every stage of the runs in a directory, or of the run that it is; all ranks call it. `verify`:
    also one for every product, all of whose bytes the ranks compare with its checksums; UserError where some differ."""
    for line in in_files(comm, directory, lambda: list(status_lines(directory))):
        _print(comm, line)
    if not verify:
        return
    products, damaged = in_files(comm, directory, lambda: products_in(directory)), 0
    for path in products:
        old = on_first_rank(comm, lambda: before_checksums(path))
        complaint = None if old else find_damage(comm, path)
        damaged += complaint is not None
        _print(comm, f"{complaint}; {make_again(path.stem)}" if complaint else
               f"{path}: {'holds no checksums, made by an earlier version' if old else 'as written'}")
    if damaged:
        raise UserError(f"{directory}: {damaged} of {len(products)} products are damaged")


def products_in(directory: Path) -> list[Path]:
    """The products of all runs in a directory, in order of their names; of links only those that lead elsewhere."""
    names = [stage.file for stage in STAGES.values() if stage.product]
    found = sorted((path for name in names for path in directory.rglob(name)), key=Path.is_symlink, reverse=True)
    return sorted({path.resolve(): path for path in found}.values())


def before_checksums(path: Path) -> bool:
    """Whether a product is of a version that made no checksums."""
    try:
        with open_to_read(path) as file:
            return ATTRIBUTE not in file.attrs
    except (OSError, ProductError):
        return False


def _print(comm: Comm, line: str) -> None:
    if comm.rank == 0:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


def status_lines(directory: Path) -> Iterator[str]:
    """Those of all runs, in order of their names; UserError where there is none."""
    found = [directory] if is_run(directory) else sorted(path.parent for path in directory.glob(f"**/{SCENE}"))
    if not found:
        raise UserError(f"{directory}: holds no run; make one with `eddies run SCENE`, or give the directory of one")
    inner: set[Path] = set()
    for path in found:
        if path not in inner:
            yield from run_lines(path, inner)


def is_run(directory: Path) -> bool:
    """Whether stages have worked here."""
    return (directory / SCENE).is_file() or any((directory / stage.file).is_file() for stage in STAGES.values())


def run_lines(directory: Path, inner: set[Path]) -> Iterator[str]:
    """Its name, size and job, then its stages, those of variants in their directories, which are added to `inner`."""
    files = [path for path in directory.rglob("*") if path.is_file() and not path.is_symlink()]
    size, held = in_units(sum(path.stat().st_size for path in files)), find_lock(directory)
    job = "" if held is None else f", {held.holder}{', without a sign of life' if held.stale else ''}"
    try:
        scene = load_scene(directory / SCENE)
    except SceneError as error:
        yield f"{directory}  {size}{job}: {error}"
        return
    yield f"{directory}  {size}{job}: {scene.title}"
    planned = steps(scene, tuple(STAGES), directory)
    inner |= {step.directory for step in planned}
    found = [(step, name) for step in planned for name in step.stages if name in step.scene.stages]
    titles = [name if step.directory == directory else f"{step.directory.relative_to(directory)}: {name}"
              for step, name in found]
    width = max(map(len, [*titles, "train-kernel"]))
    for title, (step, name) in zip(titles, found):
        seconds, state = stage_seconds(step.directory), stage_state(STAGES[name], step.scene, step.directory)
        took = duration(seconds[name]) if name in seconds else ""
        yield f"  {title:{width}}  {took:>12}  {state}".rstrip()
    took = duration(seconds["report"]) if "report" in (seconds := stage_seconds(directory)) else ""
    yield f"  {'report':{width}}  {took:>12}  {page_state(directory, planned)}"


def stage_state(stage: Stage, scene: Scene, directory: Path) -> str:
    """What there is of a stage, in words."""
    product, found = directory / stage.file, checkpoints_in(directory / stage.checkpoints) if stage.checkpoints else []
    if is_done(stage.name, scene, directory):
        return f"complete, {in_units(product.stat().st_size)}"
    if found:
        fits = stage_fingerprint(scene, stage.name) in [fingerprint for _, fingerprint in found]
        return f"stopped at step {found[-1][0]}, {'goes on' if fits else 'with other settings'}"
    if product.is_file():
        origin = product_provenance(product)
        return "made with " + of_other_settings(changed_settings(stage, origin.get("scene"), scene.to_toml())) if (
            origin) else "damaged, unfinished or of another version"
    return "to do"


def page_state(directory: Path, planned: Sequence[Step]) -> str:
    """The state of the report: to do, older than a product of these steps, or complete."""
    page = directory / PAGE
    if not page.is_file():
        return "to do"
    products = [step.directory / STAGES[stage].file for step in planned for stage in step.stages]
    old = any(path.stat().st_mtime > page.stat().st_mtime for path in products if path.is_file())
    return f"older than the products: `eddies report {directory}`" if old else f"complete, {page}"
