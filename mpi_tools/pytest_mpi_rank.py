"""The inner half of the plugin `pytest_mpi`: one rank of `mpirun -n RANKS python -m pytest MODULES`."""

import contextlib
import faulthandler
import json
import os
import signal
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

GRACE = 3.0  # seconds in which the other ranks must end a test that has failed on one


class InnerRun:
    """Runs tests of FOLDER/tests.json on this rank: those in the modules that this mpirun takes.

    The results of the tests go to FOLDER/RANK.jsonl.
    """

    def __init__(self, folder: Path):
        # This plugin has a communicator of its own, where messages that a failing test leaves on COMM_WORLD cannot
        # arrive.
        self.comm = MPI.COMM_WORLD.Dup()
        tests = json.loads((folder / "tests.json").read_text())
        self.folder, self.taken, self.timeouts = folder, Path(tests["taken"]), tests["timeouts"]
        self.results = open(folder / f"{self.comm.rank}.jsonl", "w", buffering=1)
        self.stack = open(folder / f"{self.comm.rank}.stack", "w")
        # mpirun ends the ranks of an aborted run with SIGTERM. Each rank then writes its stack.
        faulthandler.register(signal.SIGTERM, file=self.stack, chain=True)

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items):
        collected = {item.nodeid: item for item in items}
        items[:] = [collected[nodeid] for nodeid in self.timeouts]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session):
        """Run the tests module by module. If a module could not be collected, pytest's own loop ends the run."""
        if session.testsfailed:
            return None
        for number, (_, items) in enumerate(groupby(session.items, key=lambda item: item.path)):
            if self.take(number):
                first, *others = items
                for item, following in zip([first, *others], [*others, None]):
                    item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        return True

    def take(self, number: int) -> bool:
        """Take the module of this number if no run has it; return whether this run has it."""
        link = self.taken / str(number)
        with contextlib.suppress(FileExistsError):
            link.symlink_to(self.folder)
        return os.readlink(link) == str(self.folder)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        timeout = self.timeouts[item.nodeid]
        self.reports = []
        self.write(start=item.nodeid)
        faulthandler.dump_traceback_later(timeout, exit=True, file=self.stack)
        handled = yield
        record = self.record()
        self.write(end=item.nodeid, **record)
        wait = GRACE if record["outcome"] == "failed" else timeout
        faulthandler.dump_traceback_later(wait, exit=True, file=self.stack)
        agree = self.agree(record["outcome"])
        faulthandler.cancel_dump_traceback_later()
        if not agree:
            os._exit(0)  # MPI_Finalize could wait for a message that a failed rank never received
        return handled

    def pytest_runtest_logreport(self, report):
        self.reports.append(report)

    def pytest_sessionfinish(self, session, exitstatus):
        if exitstatus == pytest.ExitCode.TESTS_FAILED:
            # Otherwise mpirun would abort the ranks that have not ended yet.
            session.exitstatus = pytest.ExitCode.OK

    def record(self) -> dict:
        """Return the outcome of the test on this rank.

        It is that of the first phase (setup, call, teardown) that did not pass, or of the last phase if all passed.
        """
        report = next((r for r in self.reports if not r.passed), self.reports[-1])
        return {"rank": self.comm.rank, "outcome": report.outcome, "phase": report.when,
                "text": reason(report), "expected": hasattr(report, "wasxfail"),
                "seconds": sum(r.duration for r in self.reports),
                "sections": self.reports[-1].sections}

    def agree(self, outcome: str) -> bool:
        """Wait until all ranks have ended the test, and return whether all had this outcome."""
        code = ["passed", "skipped", "failed"].index(outcome)
        mine, both = np.array([code, -code]), np.empty(2, int)
        self.comm.Allreduce(mine, both, op=MPI.MAX)
        return both[0] == -both[1]

    def write(self, **entry):
        self.results.write(json.dumps(entry) + "\n")


def reason(report) -> str:
    """Return the traceback of a test, or the reason why the test was skipped or was expected to fail."""
    if hasattr(report, "wasxfail"):
        return report.wasxfail
    return report.longrepr[2] if report.skipped else report.longreprtext
