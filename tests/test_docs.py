"""README.md and docs say what is true: their commands, scenes, keys, links and code are those of this checkout."""

import contextlib
import csv
import dataclasses
import itertools
import json
import re
import shlex
import shutil
import sys
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import h5py
import numpy as np
import pytest

from eddies.cli import build_parser, main
from eddies.flow.initial_fields import random_velocity
from eddies.particles.flow_units import BEYOND_DISSIPATION, BEYOND_NYQUIST, LEAST_TRANSFER
from eddies.particles.resolved_velocity import TOLERANCE, TOLERANCE_PREDICTED, WEIGHT
from eddies.pipeline import STAGES
from eddies.scene.integrators import SCHEMES
from eddies.scene.model import Model, settings_class
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError, Tracers, builtin_scenes, load_scene
from eddies.scene.sections import METHODS, SET_KEYS, Simulation
from eddies.scene.terms import DEFAULT_PRESET, PRESETS, TERMS
from eddies.workflows.estimates import estimate, most_ranks
from tests.commands import python
from tests.validation.flows import make_grid

CHECKOUT = Path(__file__).parents[1]
PAGES = [CHECKOUT / "README.md", *(page for pages in ("*.md", "notebooks/*.ipynb")
                                   for page in sorted((CHECKOUT / "docs").glob(pages)))]
# Programs of the system that are mentioned; what follows them is not looked at, but for paths.
OF_THE_SYSTEM = ("module", "export", "source", "python3",
                 *(f".venv/bin/{name}" for name in ("pip", "sphinx-build", "jupyter")))
BATCH = ("sbatch", "qsub", "bsub", "flux")


def text_of(page):
    """The text of a page; for a notebook its text without code."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")


README = text_of(PAGES[0])
TEXT = "\n".join(map(text_of, PAGES))


def blocks(language):
    """The code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def marked(name):
    """The text between the comments NAME and end of NAME."""
    return TEXT.split(f"<!-- {name} -->")[1].split(f"<!-- end of {name} -->")[0].strip()


OF_THE_MACHINE = "of memory here|are free here"  # a warning of a small machine, not of a command
COMMANDS = [line.strip() for block in blocks("bash") for line in block.replace("\\\n", " ").splitlines()
            if line.strip() and not line.strip().startswith("#")]
# Scenes that begin with a comment with their file name.
EXAMPLES = dict(match.groups() for block in blocks("toml")
                if (match := re.fullmatch(r"# (\S+\.toml).*?\n(.*)", block, re.DOTALL)))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the example scenes and their classes, to work in."""
    for name, text in EXAMPLES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    shutil.copy(CHECKOUT / "docs/examples/own_pair_force.py", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def convert(monkeypatch):
    """A function that stores datasets in a file of a folder and converts this cube as docs/own-flow.md does. It returns
    the result, (component, z, y, x)."""
    program = next(code for code in blocks("python") if code.startswith("# convert.py"))

    def converted(folder, name, datasets):
        if name.endswith(".npz"):
            np.savez(folder / name, **datasets)
        else:
            with h5py.File(folder / name, "w") as file:
                file.update(datasets)
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            patch.setattr(sys, "argv", ["convert.py", name])
            exec(compile(program, "convert.py", "exec"), {})
        with h5py.File(folder / "my-cube.h5") as file:
            return np.moveaxis(file["velocity_0001"][()], -1, 0)

    return converted


def turbulence(comm):
    """The velocity of a solenoidal flow on 64^3 points, (component, z, y, x)."""
    grid = make_grid(comm, 64)
    return grid.backward(random_velocity(grid, seed=1, amplitude=1.0, peak_wavenumber=3.0))


def words_of(command):
    """Words of a command without variables set before it, `name=$(...)` around it, and what starts the ranks."""
    words = shlex.split(re.sub(r"^\w+=\$\((.*)\)", r"\1", command), comments=True)
    while re.fullmatch(r"[A-Z_0-9]+=.*", words[0]):
        words = words[1:]
    if words[:2] == ["python", "mpi_tools/launch.py"]:
        return words[words.index("--") + 1:]
    if words[0] in ("mpirun", "srun"):
        return words[3 if words[1] == "-n" else 2 if words[1].startswith("--mpi=") else 1:]
    return words


def check_eddies(arguments):
    """The command line is accepted, and its scene passes its checks."""
    options = build_parser().parse_args(arguments)
    if getattr(options, "scene", None):
        in_checkout = options.scene.startswith("docs/")
        load_scene(CHECKOUT / options.scene if in_checkout else options.scene, getattr(options, "overrides", []),
                   getattr(options, "removals", []))


@pytest.mark.parametrize("command", COMMANDS)
def test_command_exists(command, folder):
    words = words_of(command)
    program = words[0].removeprefix(".venv/bin/")
    if program == "eddies":
        check_eddies(words[1:])
    elif words[:2] == ["bash", "jobs/local.sh"]:
        given = words[2:]
        scene = [] if given and not given[0].startswith("-") else ["hit-small"]
        check_eddies(["run", *scene, *given])
    else:
        assert program in ("bash", "python", *BATCH) or words[0] in OF_THE_SYSTEM
    for path in re.findall(r"(?:mpi_tools|jobs|tests|src|docs)/[\w./-]+", command):
        assert (CHECKOUT / path).exists(), path


@pytest.mark.mpi(1)
@pytest.mark.parametrize("command", dict.fromkeys(
    shlex.join(shlex.split(line, comments=True)) for line in COMMANDS if re.match(r"eddies (scenes|check)", line)))
def test_cheap_command_runs(comm, command, folder, convert, capfd):
    if "my-cube" in command:
        convert(folder, "cube.npz", dict(zip("uvw", turbulence(comm))))
    assert main(shlex.split(command)[1:]) == 0
    output = capfd.readouterr().out
    warnings = [line for line in output.splitlines() if "warning" in line and not re.search(OF_THE_MACHINE, line)]
    assert output and warnings == []


def test_readme_is_short():
    assert len(README.encode()) <= 8_000


def test_commands_in_the_text_exist():
    choices = build_parser()._subparsers._group_actions[0].choices
    assert set(re.findall(r"`eddies ([a-z-]+)", TEXT)) == set(choices)


def test_options_in_the_text_exist():
    listed = {option for command in build_parser()._subparsers._group_actions[0].choices.values()
              for action in command._actions for option in action.option_strings}
    for option in re.findall(r"`(--(?:set|output|overwrite)\b)", TEXT):
        assert option in listed
    assert all(f"`{option}" in TEXT for option in listed if option.startswith("--") and option != "--help")


def test_changes_of_scenes_in_the_text_are_accepted_by_a_built_in_scene():
    changes = set(re.findall(r"`[^`\n]*?--set ([a-z][\w.-]+=[^\s`]+)", TEXT))

    def accepted(name, change):
        with contextlib.suppress(SceneError):
            return bool(load_scene(name, [change]))
        return False

    assert changes > (patterns := {"section.key=value", "variant.NAME.section.key=value"})
    for change in changes - patterns:
        assert any(accepted(name, change) for name, _ in builtin_scenes()), change


def test_variables_in_the_text_are_read_somewhere():
    code = "".join(path.read_text() for pattern in ("src/**/*.py", "mpi_tools/*", "jobs/*")
                   for path in CHECKOUT.glob(pattern) if path.is_file())
    named = set(re.findall(r"EDDIES_\w+", TEXT))
    assert named and all(name in code for name in named)
    assert set(re.findall(r"EDDIES_[A-Z]+", code)) <= named


def test_example_scenes_have_all_stages(folder):
    for name, left_out in (("slower-sound", {"reconstruct", "find-step"}), ("my-flow", {"reconstruct"})):
        scene = load_scene(f"{name}.toml")
        assert scene.name == name and scene.stages == tuple(stage for stage in STAGES if stage not in left_out)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("file", ["cube.h5", "cube.npz"])
def test_a_cube_of_any_layout_is_converted(comm, tmp_path, convert, file):
    velocity = turbulence(comm)
    layouts = [datasets for stored in (velocity, velocity.transpose(0, 3, 2, 1)) for datasets in (
        dict(zip("uvw", stored)), {"velocity": stored}, {"velocity": np.moveaxis(stored, 0, -1)})]
    for number, datasets in enumerate(layouts):
        (folder := tmp_path / str(number)).mkdir()
        assert np.array_equal(convert(folder, file, datasets), velocity)


@pytest.mark.parametrize("name, base", itertools.product(["my-cube.toml", "from-cube.toml"],
                                                         ["tiny", "hit-small", "hit-coarse"]))
def test_the_scene_of_a_cube_takes_any_base(folder, name, base):
    """Also one whose flow starts in another way."""
    Path(name).write_text(EXAMPLES[name].replace('base = "hit-small"', f'base = "{base}"'), encoding="utf-8")
    scene = load_scene(name)
    assert (scene.initial.kind, scene.initial.path, scene.forcing, scene.spin_up) == ("file", "my-cube.h5", None, None)


def test_the_scene_with_an_own_pair_force_differs_from_the_published_system_in_this_force(folder):
    variants = load_scene("my-cube-force.toml").variant
    published, own = (variants[name].model.settings for name in ("paper", "mine"))
    assert [*own] == ["PairForce", *[*published][1:]]
    assert all(own[name] == settings for name, settings in published.items() if name != "pairs")


def test_numbers_of_the_own_flow_follow_its_rules(folder):
    """Those of docs/own-flow.md, which `eddies check` prints."""
    scene = load_scene("my-flow.toml")
    expected = estimate(scene).scales
    assert 1.2 < scene.flow.cells // 3 * expected["kolmogorov_length"] < 1.25
    assert scene.tracers.frame_interval == pytest.approx(expected["kolmogorov_time"] / 3, rel=0.05)
    assert scene.time.max_step == pytest.approx(expected["kolmogorov_time"] / 30, rel=0.05)
    assert scene.tracers.filter_width == pytest.approx(36 * expected["kolmogorov_length"], rel=0.02)
    text = (CHECKOUT / "docs/own-flow.md").read_text(encoding="utf-8")
    ranks = [min(most_ranks(each).values()) for each in (scene.ground_truth_alone, scene)]
    assert f"| {ranks[0]}, {ranks[1]} |" in text and f"--ntasks-per-node={ranks[1]} " in text


def test_table_of_scenes():
    rows = [f"| `{name}` | {title} |" for name, title in builtin_scenes()]
    assert marked("scenes").splitlines()[2:] == rows


def allowed(rule):
    """The values that a key may have, in few words."""
    words = [quoted(word) for word in rule.words]
    if rule.kind is bool:
        return "true, false"
    if rule.kind is str and words:
        return ("list of " if rule.many else "") + ", ".join(words) + (" or an import path" if rule.paths else "")
    noun = {float: "number", int: "integer", str: "string or integer ≥ 1" if rule.numbered else "string"}[rule.kind]
    symbols = {"above": ">", "at_least": "≥", "below": "<", "at_most": "≤"}
    limits = " and ".join(f"{symbols[name]} {'π' if bound == BOX_LENGTH / 2 else format(bound, 'g')}"
                          for name, bound in rule.bounds.given.items())
    return " or ".join([f"{f'list of {noun}s' if rule.many else noun} {limits}".strip(), *words])


def key_row(field):
    """The cells of the row of a key."""
    rule = field.metadata["rule"]
    if field.default is dataclasses.MISSING:
        default = "required"
    else:
        default = "none" if field.default is None else quoted(field.default)
    return field.name, default, allowed(rule), rule.about


def section_rows(name, kind, need="", shown=None):
    """The rows of a section and of its inner sections. Keys that an earlier section has shown, a dict of rows and
    sections, are named only."""
    shown = {} if shown is None else shown
    rows = {key.name: key_row(key) for key in dataclasses.fields(kind) if "rule" in key.metadata}
    known = [key for key, row in rows.items() if row in shown]
    about = kind.__doc__.splitlines()[0]
    if known:
        (section,) = {shown[rows[key]] for key in known}
        about += f" {', '.join(known)}: as in [{section}]."
    yield f"[{name}]{need}", "", "", about
    yield from (row for row in rows.values() if row not in shown)
    yield from inner_rows(kind, f"{name}.")
    if kind is Model:
        terms = {}
        for word in TERMS:
            yield from section_rows(f"model.{word}", settings_class(word), shown=terms)
            terms |= {key_row(key): terms.get(key_row(key), f"model.{word}")
                      for key in dataclasses.fields(settings_class(word)) if "rule" in key.metadata}
    if kind is Tracers:
        yield "[tracers.NAME], optional", "", "", f"A set of tracers; keys: {', '.join(SET_KEYS)}."


def inner_rows(kind, prefix):
    """The rows of the sections in a section, or in the whole scene."""
    for field in dataclasses.fields(kind):
        if field.metadata.get("section"):
            need = {dataclasses.MISSING: ", required", None: ", optional"}.get(field.default, "")
            yield from section_rows(f"{prefix}{field.name}", field.metadata["section"], need)


def test_scene_reference():
    """The reference has the declarations of the keys."""
    keys = [key_row(field) for field in dataclasses.fields(Scene) if "rule" in field.metadata]
    with open(CHECKOUT / "docs/scene-reference.csv", encoding="utf-8", newline="") as file:
        found = [*csv.reader(file)]
    assert found == [list(row) for row in (("key", "default", "values", "meaning"), *keys, *inner_rows(Scene, ""))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_row_of_a_table_has_the_columns_of_its_head(page):
    """A bar within a cell would move the text behind it out of the table."""
    for table in re.findall(r"(?:^\|.*\n)+", text_of(page), re.MULTILINE):
        head, rule, *rows = table.splitlines()
        assert re.fullmatch(r"\|( *:?---+:? *\|)+", rule), head
        columns = {len(re.findall(r"(?<!\\)\|", row)) for row in (head, rule, *rows)}
        assert len(columns) == 1, head


def test_only_the_scene_of_the_text_sets_a_step():
    scenes = {name: load_scene(name).simulation for name, _ in builtin_scenes()}
    assert [name for name, simulation in scenes.items() if simulation and simulation.step != "converged"] == ["cbc"]
    assert "Of the built-in scenes only `cbc` sets a step." in TEXT


@pytest.mark.parametrize("words, default, heading", [
    (PRESETS, DEFAULT_PRESET, "| preset | equation | needs |"),
    (METHODS, Simulation.__dataclass_fields__["method"].default, "| `method` | what moves the particles |"),
])
def test_a_table_explains_every_choice(words, default, heading):
    table = TEXT.split(heading)[1].split("\n\n")[0]
    assert re.findall(r"^\| `([a-z +-]+)`", table, re.MULTILINE) == list(words)
    assert re.findall(r"^\| `([a-z-]+)` \(default\)", table, re.MULTILINE) == [default]


def test_table_of_presets_lists_their_terms():
    table = TEXT.split("| preset | equation |")[1].split("\n\n")[0]
    for preset, terms in PRESETS.items():
        (listed,) = re.findall(rf"^\| `{re.escape(preset)}`[^|]*\|([^|]*)\|", table, re.MULTILINE)
        assert re.findall(r"`([a-z-]+)`", listed) == list(terms)


def test_every_term_is_in_the_table():
    table = TEXT.split("| term | what it gives | learned |")[1].split("\n\n")[0]
    named = [word for row in table.splitlines()[2:] for word in re.findall(r"`([^`]+)`", row.split("|")[1])]
    assert set(named) == {*TERMS, '"module:name"'}


def rows_of(name):
    """The rows of a table in docs, which has no empty cells."""
    with open(CHECKOUT / "docs" / name, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(all(row.values()) for row in rows)
    return rows


def test_every_guarantee_names_tests_that_exist():
    guarantees = rows_of("guarantees.csv")
    assert len(guarantees) > 50
    for row in guarantees:
        for test in row["tests"].split():
            path, name = test.split("::")
            assert f"\ndef {name}(" in (CHECKOUT / "tests" / path).read_text(), test


def test_functions_of_the_equations_exist():
    equations = rows_of("equations.csv")
    assert len(equations) > 15
    for row in equations:
        for function in row["functions"].split():
            module, name = function.split(":")
            assert attrgetter(name)(import_module(f"eddies.{module}")), function


def test_constants_of_the_resolved_velocity_are_those_of_the_code():
    def power(number):
        return f"{number:.0e}".replace("e-0", "e-")

    angle = {name: f"{scheme.angle:g}" for name, scheme in SCHEMES.items()}
    assert WEIGHT == 100
    page = " ".join(text_of(CHECKOUT / "docs/methods.md").split())
    for words in (f"the lowest of {BEYOND_NYQUIST:g} k_N, {BEYOND_DISSIPATION:g}/η, and the wavenumber at which the "
                  f"filter leaves {LEAST_TRANSFER:g}", "σ² is 100 times the energy that the prior expects beyond k_c",
                  f"a residual of {power(TOLERANCE_PREDICTED)} of the velocities' rms; without a forecast at "
                  f"{power(TOLERANCE)}", f"at most {angle['rk3']} for `rk3` and `rk2`, {angle['rk4']} for `rk4`, and "
                  f"{angle['verlet']} for `verlet` and `corrected-verlet`"):
        assert words in page, words
    assert angle["rk2"] == angle["rk3"] and angle["corrected-verlet"] == angle["verlet"]
    assert "σ² a hundred times the expected energy beyond k_c" in " ".join(
        text_of(CHECKOUT / "docs/how-it-works.md").split())


def test_formulas_and_examples_shown_are_those_of_the_files():
    for language, start, path in (("cpp", "", "src/eddies/kernels/summands.hpp"),
                                  ("python", "@dataclass", "docs/examples/own_pair_force.py")):
        source = (CHECKOUT / path).read_text(encoding="utf-8")
        shown = [block for block in blocks(language) if block.startswith(start)]
        assert shown and all(block.strip() in source for block in shown)


def test_example_with_variants(tmp_path):
    example = next(block for block in blocks("toml") if "[variant.small]" in block)
    (tmp_path / "example.toml").write_text(example, encoding="utf-8")
    assert list(load_scene(tmp_path / "example.toml").variant) == ["learned", "small", "no-force"]


def slug(heading):
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_files_of_a_page_exist(page):
    text = text_of(page)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if not link.startswith("https://"):
            path, _, anchor = link.partition("#")
            target = page.parent / path if path else page
            assert target.exists(), link
            headings = re.findall(r"^#+ (.+)$", text_of(target), re.MULTILINE) if anchor else []
            assert not anchor or anchor in map(slug, headings), link
    for path in re.findall(r"`((?:mpi_tools|jobs|tests|src|docs)/[\w./-]*)`", text):
        assert (CHECKOUT / path).exists(), path
    assert not re.search(r"^[A-Z]+(_[A-Z]+)*$|<[A-Z]+>", text, re.MULTILINE)  # nothing left to fill in


@pytest.mark.mpi(1)
@pytest.mark.parametrize("program", [code for code in blocks("python") if "runs/hit-small" in code],
                         ids=["h5py", "open_run", "read_tracks"])
@pytest.mark.usefixtures("undrawn", "quick_spectra")
def test_python_runs_on_the_files_of_a_run(comm, tmp_path, monkeypatch, capsys, program):
    from eddies.workflows import report
    from tests.left_out import leave_out_figures
    from tests.workflows.synthetic_run import write_run
    write_run(comm, tmp_path / "runs/hit-small")
    if "metrics" in program:
        with monkeypatch.context() as patch:
            leave_out_figures(patch)
            report.run(tmp_path / "runs/hit-small", comm)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "docs", "exec"), {})
    assert "nan" not in capsys.readouterr().out


def test_the_site_builds_without_a_warning(tmp_path):
    """All but the writing of HTML."""
    built = python("-m", "sphinx", "-q", "-W", "-b", "dummy", CHECKOUT / "docs", tmp_path / "site", timeout=200)
    assert built.returncode == 0 and not built.stderr, built.stderr
