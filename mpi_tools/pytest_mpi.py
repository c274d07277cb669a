"""Pytest plugin: `mpirun -n RANKS python -m pytest -m mpi` runs the tests that are marked for this number of ranks.

    @pytest.mark.mpi(1, 2, timeout=30)
    def test_sum(comm):
        assert comm.allreduce(1) == comm.size

Every rank runs these tests, in the same order. Rank 0 shows the progress. If a test fails on any of several ranks, this
rank prints the report, and the job ends at once. If a test exceeds its time limit, all ranks print their stacks, and
the job ends. In both cases the exit code is not zero.

Without `-m mpi`, pytest runs the tests that are not marked. It does not initialise MPI then, because Open MPI 4 cannot
start mpirun from a process that has initialised it.
"""

import faulthandler
import gc
import os
import re
import signal
import sys

import pytest

RANKS = {1, 2, 3}  # on which test.sh runs tests
TIMEOUT = 120      # seconds for one test
GRACE = 2          # seconds in which all ranks print their stacks, after the time limit


@pytest.hookimpl(trylast=True)  # after the terminal reporter is made
def pytest_configure(config):
    gc.disable()  # imports during collection make millions of objects and no garbage
    if config.option.markexpr == "mpi":
        from mpi4py import MPI
        config.pluginmanager.register(Rank(config, MPI.COMM_WORLD), "mpi-rank")
    else:
        import mpi4py
        mpi4py.rc.initialize = mpi4py.rc.finalize = False


def pytest_collection_modifyitems(items):
    for item in items:
        marker = item.get_closest_marker("mpi")
        if marker and not RANKS.issuperset(marker.args or [None]):
            raise pytest.UsageError(f"{item.nodeid}: mpi{marker.args}: numbers of ranks among {RANKS} are expected")


def pytest_collection_finish():
    gc.freeze()  # later garbage collections leave out the imported objects
    gc.enable()


class Rank:
    """Runs the marked tests on this rank."""

    def __init__(self, config, comm):
        self._comm = comm
        self._stacks = open(os.dup(sys.stderr.fileno()), "w")  # also while pytest captures the output of a test
        if comm.rank > 0:
            config.pluginmanager.unregister(name="terminalreporter")
            config.pluginmanager.register(pytest.TerminalReporter(config, open(os.devnull, "w")), "terminalreporter")

    @pytest.fixture(scope="session")
    def comm(self):
        """All ranks of the job."""
        return self._comm

    @pytest.fixture
    def tmp_path(self, tmp_path):
        """The folder `tmp_path` of rank 0."""
        return self._comm.bcast(tmp_path)

    def pytest_ignore_collect(self, collection_path):
        """A file without a test for this number of ranks is not even imported."""
        if collection_path.name.startswith("test_") and collection_path.suffix == ".py":
            marks = re.findall(r"mark\.mpi\(([\d, ]*)", collection_path.read_text(encoding="utf-8"))
            return None if any(str(self._comm.size) in mark.split(", ") for mark in marks) else True
        return None

    def pytest_collection_modifyitems(self, config, items):
        def is_chosen(item):
            marker = item.get_closest_marker("mpi")
            return marker is not None and self._comm.size in marker.args

        config.hook.pytest_deselected(items=[item for item in items if not is_chosen(item)])
        items[:] = filter(is_chosen, items)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        timeout = item.get_closest_marker("mpi").kwargs.get("timeout", TIMEOUT)
        faulthandler.dump_traceback_later(timeout, file=self._stacks)
        signal.alarm(timeout + GRACE)  # ends this process, and mpirun then ends the others
        handled = yield
        self._comm.Barrier()  # ranks that no longer agree do not get to the next test
        signal.alarm(0)
        faulthandler.cancel_dump_traceback_later()
        return handled

    def pytest_runtest_logreport(self, report):
        if report.failed and self._comm.size > 1:
            captured = [f"--- {title} ---\n{text}" for title, text in report.sections]
            lines = [f"\nrank {self._comm.rank} of {self._comm.size}: {report.nodeid} failed in {report.when}",
                     report.longreprtext, *captured, ""]
            os.write(2, "\n".join(lines).encode())  # at once, so that no message of mpirun stands between
            self._comm.Abort(1)

    pytest_collectreport = pytest_runtest_logreport

    def pytest_sessionfinish(self, session, exitstatus):
        if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED:  # a selection may have none for this number of ranks
            session.exitstatus = pytest.ExitCode.OK
