"""A Slurm on this machine for tests: its daemons, with their own ports and files."""

import getpass
import os
import re
import shutil
import socket
import subprocess
import time
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
PATH = f"{os.environ['PATH']}:/usr/sbin"
# There are more CPUs than processors, so that all jobs of the tests run at once. Pending jobs are checked every second.
# A job that is queued again starts after the life time of a credential. TmpFS holds the folders of PMIx, by job.
CONFIGURATION = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
TmpFS={folder}
MailProg=/bin/true
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1,bf_interval=1,batch_sched_delay=0
SlurmdParameters=config_overrides
KillWait=2
NodeName={host} NodeAddr=127.0.0.1 CPUs=16
PartitionName=test Nodes=ALL Default=YES
"""


def missing() -> str:
    """The reason why Slurm cannot run here, with the remedy; empty if it can."""
    absent = [name for name in DAEMONS if shutil.which(name, path=PATH) is None]
    if absent:
        return f"no {', '.join(absent)}: apt-get install slurm-wlm munge"
    return "" if os.geteuid() == 0 else "slurmd wants to be root"


class Slurm:
    """The daemons, for the time of a `with`; its end cancels the jobs that are left."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        ours = {name: value for name, value in os.environ.items()
                if not re.match("EDDIES_|OMP_|OMPI_|PMI|SBATCH_|SLURM", name)}
        self.environment = ours | {"PATH": PATH, "SLURM_CONF": str(folder / "slurm.conf")}
        self._daemons: list[subprocess.Popen] = []

    def __enter__(self) -> "Slurm":
        folder = self.folder
        for name in ("state", "spool"):
            (folder / name).mkdir()
        (folder / "munge.key").touch(0o600)
        (folder / "munge.key").write_bytes(os.urandom(128))
        with socket.socket() as first, socket.socket() as second:
            for each in (first, second):
                each.bind(("127.0.0.1", 0))
            ports = [each.getsockname()[1] for each in (first, second)]
        (folder / "slurm.conf").write_text(CONFIGURATION.format(
            folder=folder, ports=ports, user=getpass.getuser(), host=socket.gethostname().partition(".")[0]))
        # No cgroups are used; a container may have none, or read-only ones.
        (folder / "cgroup.conf").write_text(f"CgroupPlugin=cgroup/v1\nCgroupMountpoint={folder}\n")
        try:
            self._start("munged", "--foreground", "--force", *(f"--{name}-file={folder}/munge.{name}" for name in (
                "key", "log", "pid", "seed")), f"--socket={folder}/munge.socket")
            self.wait(lambda: (folder / "munge.socket").exists(), "munged")
            self._start("slurmctld", "-D")
            self._start("slurmd", "-D")
            self.wait(lambda: self.ask("sinfo", "--noheader", "--format=%t") == "idle", "a node")
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self.ask("scancel", "--user", getpass.getuser())
            self.wait(lambda: not self.ask("squeue", "--noheader"), "the end of all jobs")
        finally:
            self._end()

    def _start(self, name: str, *arguments: str) -> None:
        with open(self.folder / f"{name}.log", "w") as log:
            self._daemons.append(subprocess.Popen([shutil.which(name, path=PATH), *arguments], env=self.environment,
                                                  stdin=subprocess.DEVNULL, stdout=log, stderr=log))

    def _end(self) -> None:
        for daemon in reversed(self._daemons):
            daemon.terminate()
            try:
                daemon.wait(10)
            except subprocess.TimeoutExpired:
                daemon.kill()

    def wait(self, ready, what: str, seconds: float = 120) -> None:
        """Wait until `ready()` holds; raises TimeoutError with the logs of the daemons."""
        deadline = time.monotonic() + seconds
        while not ready():
            if time.monotonic() > deadline or any(daemon.poll() is not None for daemon in self._daemons):
                logs = "".join(f"--- {path.name}\n{path.read_text()[-2000:]}" for path in self.folder.glob("*.log"))
                raise TimeoutError(f"Slurm: waited for {what}\n{logs}")
            time.sleep(0.05)

    def ask(self, *command: str) -> str:
        """The output of a command of Slurm; empty if it fails."""
        return subprocess.run(command, env=self.environment, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                              timeout=30).stdout.strip()

    def submit(self, *command: object, **variables: str) -> int:
        """Submit a job with `sbatch`, these arguments and further variables; its number."""
        ended = subprocess.run(["sbatch", "--parsable", *map(str, command)], env=self.environment | variables,
                               cwd=self.folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=30)
        assert ended.returncode == 0, ended.stderr
        return int(ended.stdout)

    def job(self, number: int) -> dict[str, str]:
        """The record of a job, by the names of `scontrol show job`."""
        return dict(re.findall(r"(\w+)=(\S*)", self.ask("scontrol", "show", "job", str(number))))

    def output(self, number: int) -> str:
        """The output of a job so far."""
        path = self.folder / f"slurm-{number}.out"
        return path.read_text() if path.exists() else ""
