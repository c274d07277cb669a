"""Pytest plugin: `@pytest.mark.mpi(1, 2, 3)` runs a test under mpirun on each of these numbers of ranks.

    @pytest.mark.mpi(1, 2, timeout=30)
    def test_sum(comm):
        assert comm.allreduce(1) == comm.size

The pytest process that the user starts, the outer process, never initialises MPI, because Open MPI 4 cannot start
mpirun from a process that has initialised it. The outer process starts one `mpirun -n RANKS python -m pytest MODULES`,
an inner run, for all selected tests with the same number of ranks, because starting ranks takes longer than most tests.
Every rank writes JSON lines, from which each test is reported. If the ranks disagree about a test, or the test exceeds
its time limit, this mpirun ends and a new one runs the following tests. Tests run in the order of their numbers of
ranks. Several mpirun share the modules with one-rank tests. All ranks of a test have the same `tmp_path`, but not the
same `tmp_path_factory`.
"""

import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from mpi_tools.launch import local_cores, mpi_environment, mpirun_command

TIMEOUT = 120.0  # seconds for one test on all its ranks
STALL = 60.0     # seconds after the time limit of a test; if there is no result by then, mpirun is stopped
BESIDE = 4       # largest number of mpirun that run one-rank tests at the same time


def pytest_addoption(parser):
    parser.addoption("--mpi-run", metavar="DIR", help="internal: act as a rank of the run in DIR")


def pytest_configure(config):
    gc.disable()  # imports during collection make millions of objects and no garbage
    config.addinivalue_line("markers", "mpi(*ranks, timeout=120): run under mpirun on these numbers of ranks")
    folder = config.getoption("--mpi-run")
    if folder:
        from mpi_tools.pytest_mpi_rank import InnerRun
        config.pluginmanager.register(InnerRun(Path(folder)), "mpi-inner")
    else:
        import mpi4py
        mpi4py.rc.initialize = mpi4py.rc.finalize = False
        config.pluginmanager.register(OuterRun(config), "mpi-outer")


def pytest_collection_finish():
    gc.freeze()  # later garbage collections leave out the imported objects
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_generate_tests(metafunc):
    marker = metafunc.definition.get_closest_marker("mpi")
    if marker is None:
        return
    if not marker.args or not all(isinstance(ranks, int) and ranks > 0 for ranks in marker.args):
        pytest.fail(f"mpi{marker.args}: positive numbers of ranks are expected", pytrace=False)
    metafunc.fixturenames.append("mpi_ranks")
    metafunc.parametrize("mpi_ranks", marker.args, ids="mpi-{}".format, indirect=True)


@pytest.fixture
def mpi_ranks(request):
    """Number of ranks on which the test runs."""
    return request.param


@pytest.fixture(scope="session")
def comm(pytestconfig):
    """MPI.COMM_WORLD of the inner run."""
    if not pytestconfig.getoption("--mpi-run"):
        pytest.fail("the fixture comm needs @pytest.mark.mpi(RANKS, ...) on the test", pytrace=False)
    from mpi4py import MPI
    return MPI.COMM_WORLD


@pytest.fixture
def tmp_path(request, pytestconfig, tmp_path):
    """The folder tmp_path of pytest. For an MPI test, it is the same folder on all ranks."""
    folder = pytestconfig.getoption("--mpi-run")
    if not folder:
        return tmp_path
    name = f"{request.node.path.stem}-{request.node.name}"
    shared = Path(folder, "tmp", "".join(c if c.isalnum() else "-" for c in name))
    shared.mkdir(parents=True, exist_ok=True)
    return shared


class OuterRun:
    """Replaces each marked test by an `MpiItem`, and starts the mpirun that run these tests."""

    def __init__(self, config):
        self.config = config
        self.runs, self.reported, self.ahead = [], None, False  # ahead: tests start before their turn
        self.waiting = {}  # ranks -> items still to be reported, in order

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        items[:] = [MpiItem.replace(item, self) if item.get_closest_marker("mpi") else item for item in items]
        modules = list(dict.fromkeys(item.path for item in items))
        items.sort(key=lambda item: (getattr(item, "ranks", 0), modules.index(item.path)))
        for item in items:
            if isinstance(item, MpiItem):
                self.waiting.setdefault(item.ranks, []).append(item)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session):
        """Start several mpirun for the tests on one rank. They keep all cores busy while this process runs the tests
        that are not marked."""
        group, cores, shown = self.waiting.get(1), local_cores(), session.config.option.capture == "no"
        if group and cores > 1 and not shown and not session.config.option.collectonly:
            os.environ.setdefault("OMPI_MCA_mpi_yield_when_idle", "1")  # a waiting rank yields its core
            self.start(group, min(cores, BESIDE, len({item.path for item in group})))
            self.ahead = True

    def pytest_runtest_logfinish(self):
        """Start the tests on the next number of ranks when all runs have ended, even if results wait to be reported."""
        if self.ahead and self.runs and all(run.process.poll() is not None for run in self.runs):
            later = [ranks for ranks in sorted(self.waiting) if ranks > max(run.ranks for run in self.runs)]
            for ranks in later[:1]:
                self.start(self.waiting[ranks])

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        """Report the seconds that the slowest rank took, without the time of waiting for its result."""
        report = yield
        if call.when == "call" and isinstance(item, MpiItem):
            report.duration = item.seconds
        return report

    def start(self, items, count=1):
        """Start `count` mpirun that share these tests."""
        first = RankRun(self.config, items)
        self.runs += [first, *(RankRun(self.config, items, first.taken) for _ in range(count - 1))]

    def records(self, item) -> list[dict]:
        """Return the records of all ranks for a test. If no mpirun reaches the test, start one that begins with it."""
        group = self.waiting[item.ranks]
        del group[:group.index(item)]
        run = next((run for run in self.runs if run.reaches(item)), None)
        if run is None:
            others = [run for run in self.runs if run.ranks == item.ranks and run.process.poll() is None]
            if not others:
                self.close(item.ranks)
            # The rest of the module belongs to no run; other runs take the modules after it.
            self.start([other for other in group if other.path == item.path] if others else group)
            run = self.runs[-1]
            run.reaches(item)
        self.reported = item
        return run.records(item)

    def close(self, most=None):
        """End all runs, or only those on at most `most` ranks."""
        for run in [run for run in reversed(self.runs) if most is None or run.ranks <= most]:
            self.runs.remove(run)
            run.close(self.reported)

    def pytest_sessionfinish(self):
        self.close()


class RankFailure(Exception):
    """A test failed on some rank; the text is the report."""


class MpiItem(pytest.Item):
    """Represents a test function that an mpirun executes."""

    @classmethod
    def replace(cls, function, outer):
        item = cls.from_parent(function.parent, name=function.name)
        marker = function.get_closest_marker("mpi")
        item.outer, item.ranks = outer, function.callspec.params["mpi_ranks"]
        item.timeout = float(marker.kwargs.get("timeout", TIMEOUT))
        item.place, item.seconds = function.reportinfo(), 0.0
        return item

    def runtest(self):
        records = self.outer.records(self)
        self.seconds = max(record["seconds"] for record in records)
        for record in records:
            for title, text in record["sections"]:
                stream, phase = title.split()[1:]  # "Captured stdout call"
                self.add_report_section(phase, f"{stream} of rank {record['rank']}", text)
        failed = [record for record in records if record["outcome"] == "failed"]
        if failed:
            # The traceback of the first rank that raised, or the stacks of all.
            raised = [record for record in failed if record["phase"]][:1]
            raise RankFailure("\n".join(self.describe(record) for record in raised or failed))
        skipped = next((record for record in records if record["outcome"] == "skipped"), None)
        if skipped:
            leave = pytest.xfail if skipped["expected"] else pytest.skip
            leave(skipped["text"].removeprefix("Skipped: "))

    def describe(self, record: dict) -> str:
        verb = f"failed in {record['phase']}" if record["phase"] else "did not finish"
        return f"rank {record['rank']} of {self.ranks} {verb}\n{record['text']}"

    def repr_failure(self, excinfo):
        return str(excinfo.value) if isinstance(excinfo.value, RankFailure) else super().repr_failure(excinfo)

    def reportinfo(self):
        return self.place


class RankRun:
    """One mpirun of tests on a number of ranks. Several runs may share modules: each takes some of them and runs these.

    To take a module, a run makes a link to its own folder. The link is in the folder `taken`, which the runs share, and
    its name is the number of the module.
    """

    def __init__(self, config, items: list[MpiItem], taken: Path | None = None):
        self.ranks, self.items = ranks, items = items[0].ranks, list(items)
        self.modules = list(dict.fromkeys(item.path for item in items))
        self.folder = Path(tempfile.mkdtemp(prefix="pytest-mpi-"))
        self.taken = taken or self.folder / "taken"
        self.taken.mkdir(exist_ok=True)
        tests = {"timeouts": {item.nodeid: item.timeout for item in items}, "taken": str(self.taken)}
        (self.folder / "tests.json").write_text(json.dumps(tests))
        self.read, self.found = [0] * ranks, {}  # bytes read of each rank's records; entries by event and test
        self.output = open(self.folder / "output", "w+b")
        shown = config.option.capture == "no"
        # The plugin unraisableexception is off, because its warnings would not show and its garbage collection takes a
        # second.
        inner = [sys.executable, "-m", "pytest", *map(str, self.modules), f"--mpi-run={self.folder}", "-q",
                 "--color=no", "-p", "mpi_tools.pytest_mpi", "-p", "no:cacheprovider", "-p", "no:unraisableexception",
                 f"--rootdir={config.rootpath}", f"--tb={config.option.tbstyle}",
                 *(["-c", str(config.inipath)] if config.inipath else []), *(["-s"] if shown else [])]
        path = [str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = mpi_environment(ranks) | {"PYTHONPATH": os.pathsep.join(path)}
        self.process = subprocess.Popen(
            mpirun_command(ranks, inner), cwd=config.invocation_params.dir, env=environment,
            stdin=subprocess.DEVNULL, stdout=None if shown else self.output, stderr=subprocess.STDOUT,
            start_new_session=True)

    def entries(self, item: MpiItem, event: str) -> dict[int, dict]:
        """Return, by rank, the entries written so far about the "start" or the "end" of a test."""
        for rank in range(self.ranks):
            path = self.folder / f"{rank}.jsonl"
            if not path.exists():
                continue
            with open(path, "rb") as file:
                file.seek(self.read[rank])
                for line in file:
                    if not line.endswith(b"\n"):  # still being written
                        break
                    self.read[rank] += len(line)
                    entry = json.loads(line)
                    kind = "start" if "start" in entry else "end"
                    self.found.setdefault((kind, entry[kind]), {})[rank] = entry
        return self.found.get((event, item.nodeid), {})

    def wait(self, item: MpiItem, event: str, ranks: int) -> dict[int, dict]:
        """Wait until this number of ranks have an entry of the event, and return the entries.

        The wait also ends if this run ends or another run takes the module of the test.
        """
        give_up = time.monotonic() + item.timeout + STALL
        while len(self.entries(item, event)) < ranks and self.process.poll() is None and not self.leaves(item):
            if time.monotonic() > give_up:
                self.stop()
            time.sleep(0.02)
        return self.entries(item, event)

    def reaches(self, item: MpiItem) -> bool:
        """Wait until a rank starts the test; return whether one did."""
        return item in self.items and bool(self.wait(item, "start", ranks=1))

    def leaves(self, item: MpiItem) -> bool:
        """Whether another run has taken the module of the test."""
        link = self.taken / str(self.modules.index(item.path))
        return link.is_symlink() and os.readlink(link) != str(self.folder)

    def records(self, item: MpiItem) -> list[dict]:
        """Wait until all ranks have ended the test, or the run has ended; return one record per rank."""
        ended = self.wait(item, "end", self.ranks)
        return [ended[rank] if rank in ended else self.lost(rank, item) for rank in range(self.ranks)]

    def lost(self, rank: int, item: MpiItem) -> dict:
        """Return the record of a rank that never ended the test: its last stack, or the output of the run."""
        path = self.folder / f"{rank}.stack"
        stack = path.read_text().splitlines() if path.exists() else []
        # Only the calls inside the test are kept. The innermost call comes first.
        ours = [index for index, line in enumerate(stack) if "_pytest" in line]
        stack = stack[:ours[0]] if ours else stack
        if stack and stack[0].startswith("Timeout"):
            text = f"did not end within the time limit of {item.timeout:g} s:\n"
        elif stack:
            text = "had not ended when the others had:\n"
        else:
            self.output.seek(0)
            stack = self.output.read().decode(errors="replace").splitlines()[-60:]
            text = "died; output of the run:\n"
        return {"rank": rank, "outcome": "failed", "phase": None, "text": text + "\n".join(stack),
                "sections": [], "seconds": 0.0}

    def stop(self):
        """End mpirun and its ranks."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self.process.poll() is None:
                os.killpg(self.process.pid, number)
                try:
                    self.process.wait(10)
                except subprocess.TimeoutExpired:
                    pass

    def close(self, reported: MpiItem | None):
        """Stop the run and remove its folder. After the report of its last test, it first has time to end by itself."""
        try:
            self.process.wait(10 if reported is self.items[-1] else 0)
        except subprocess.TimeoutExpired:
            self.stop()
        self.output.close()
        shutil.rmtree(self.folder, ignore_errors=True)
