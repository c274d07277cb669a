"""`eddies status`: print the state of run directories, that is, stages, their settings, checkpoints, jobs and sizes."""

from collections.abc import Iterator
from pathlib import Path

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import checkpoints_in
from eddies.io.damage import find_damage, has_checksums
from eddies.io.errors import ProductError, remedy_for
from eddies.io.hdf5 import in_files
from eddies.io.provenance import product_fingerprint, product_provenance
from eddies.io.run_lock import job_in
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.pipeline import FILE_OF, MAKER_OF, STAGES, Stage
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.workflows.estimates import in_units
from eddies.workflows.run_directory.fingerprints import set_files, stage_fingerprint
from eddies.workflows.run_directory.work import differences, newer_products, of_other_settings, stage_seconds
from eddies.workflows.variants import steps

SCENE = "scene.toml"


def run(directory: Path, comm: Comm, verify: bool = False) -> None:
    """Print a line for each stage of a run, or of all runs in a directory; all ranks call it.

    With `verify` the ranks also read all of the products, so that HDF5 compares them with their checksums, and print a
    line for each product. Raises UserError if a product is damaged or cannot be read.
    """
    for line in in_files(comm, directory, lambda: list(status_lines(directory))):
        _print(comm, line)
    if not verify:
        return
    products, damaged = in_files(comm, directory, lambda: products_in(directory)), 0
    for path in products:
        complaint = _complaint(comm, path)
        damaged += complaint is not None
        _print(comm, complaint or f"{path}: {on_first_rank(comm, lambda: _state(path))}")
    if damaged:
        raise UserError(f"{directory}: {damaged} of {len(products)} products are damaged or cannot be read")


def _complaint(comm: Comm, path: Path) -> str | None:
    """Return a line with the fault and the remedy if a product is damaged or cannot be read, else None. Collective."""
    try:
        damage = find_damage(comm, path)
    except ProductError as error:
        return str(error)
    return damage and f"{damage}; {remedy_for(path.stem)}"


def _state(path: Path) -> str:
    return "not damaged" if has_checksums(path) else "has no checksums, because an earlier version made it"


def products_in(directory: Path) -> list[Path]:
    """Return the products of all runs in a directory, sorted by path. A link to one of these products is left out."""
    found = (path for file in FILE_OF.values() for path in directory.rglob(file))
    found = sorted(found, key=Path.is_symlink, reverse=True)
    return sorted({path.resolve(): path for path in found}.values())


def _print(comm: Comm, line: str) -> None:
    if comm.rank == 0:
        print(line, flush=True)


def status_lines(directory: Path) -> Iterator[str]:
    """Yield the lines of all runs in a directory, sorted by path. Raises UserError if the directory holds no run."""
    is_run = (directory / SCENE).is_file() or any((directory / stage.file).is_file() for stage in MAKER_OF.values())
    found = [directory] if is_run else sorted(path.parent for path in directory.glob(f"**/{SCENE}"))
    if not found:
        raise UserError(f"{directory}: holds no run; make one with `eddies run SCENE`, or give the directory of one")
    inner: set[Path] = set()
    for path in found:
        if path not in inner:
            yield from run_lines(path, inner)


def run_lines(directory: Path, inner: set[Path]) -> Iterator[str]:
    """Yield a line with the path, the size and the job of a run, then a line for each stage. The directories of its
    variants are added to `inner`."""
    files = [path for path in directory.rglob("*") if path.is_file() and not path.is_symlink()]
    size, held = in_units(sum(path.stat().st_size for path in files)), job_in(directory)
    job = held and f", {held}"
    try:
        scene = load_scene(directory / SCENE)
    except SceneError as error:
        yield f"{directory}  {size}{job}: {error}"
        return
    yield f"{directory}  {size}{job}: {scene.title}"
    planned = steps(scene, tuple(STAGES), directory)
    inner |= {file.parent for step in planned for file in step.files}
    rows = []
    for step in planned:
        seconds, prefix = stage_seconds(step.directory), ""
        if step.directory != directory:
            prefix = f"{step.directory.relative_to(directory)}: "
        for name in [name for name in step.stages if name in step.scene.stages]:
            state = stage_state(STAGES[name], step.directory, step.scene)
            sets = set_files(step.scene) if name == "dns" else {}
            lacking = [path.parent.name for path, fingerprint in sets.items()
                       if product_fingerprint(step.directory / path) != fingerprint]
            if lacking and state.startswith("complete"):
                state = f"lacks the ground truth of {', '.join(lacking)}"
            rows.append((prefix + name, seconds.get(name), state))
    page = directory / STAGES["report"].file
    state = "to do"
    if page.is_file():
        state = (f"older than the products; run `eddies report {directory}`" if newer_products(page) else
                 f"complete, {page}")
    rows.append(("report", stage_seconds(directory).get("report"), state))
    width = max(len(title) for title, *_ in [*rows, ("train-kernel",)])
    for title, seconds, state in rows:
        yield f"  {title:{width}}  {'' if seconds is None else duration(seconds):>12}  {state}".rstrip()


def stage_state(stage: Stage, directory: Path, scene: Scene) -> str:
    """Describe in words the state of a stage of a scene in a directory."""
    product = directory / stage.file
    origin = product_provenance(product)
    differing = differences(stage, origin, scene)
    if differing is None:
        return f"complete, {in_units(product.stat().st_size)}"
    try:
        checkpoints = checkpoints_in(directory / stage.checkpoints) if stage.checkpoints else []
    except ProductError as error:
        return str(error)
    if checkpoints and origin.get("course") not in [fingerprint for _, fingerprint in checkpoints]:
        continued = stage_fingerprint(scene, stage.name, stage.duration)
        fits = continued in [fingerprint for _, fingerprint in checkpoints]
        return f"stopped at step {checkpoints[0][0]}, {'can continue' if fits else 'with other settings'}"
    if not product.is_file():
        return "to do"
    if not origin:
        return "damaged, unfinished or of another version"
    return f"made with {of_other_settings(differing)}" if differing else (
        "made from files that the scene names, which have changed or are not found from here")
