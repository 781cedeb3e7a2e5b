"""A whole Slurm cluster, thrown away after use: munged, slurmctld and slurmd on this machine, in one folder, as one user.

No cgroups and no accounting: `sacct` answers nothing, so submitit learns of an end by the result that a job leaves.
"""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.helpers.command_line import wait_for

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol", "squeue", "scancel", "sinfo")
LOGS = "the cluster; see daemons.log, slurmctld.log and slurmd.log in its folder"

CONFIG = """\
ClusterName=throwaway
SlurmctldHost={host}
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
AuthType=auth/munge
CredType=cred/munge
# A job put back into the queue waits until its credential has expired; the default is two minutes.
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
JobCompType=jobcomp/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=2,batch_sched_delay=0
ReturnToService=2
JobRequeue=1
KillWait=30
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=2000 State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=60 State=UP
"""


def missing() -> list[str]:
    """The programs that this machine lacks."""
    path = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin"))
    return [name for name in PROGRAMS if shutil.which(name, path=path) is None]


@contextmanager
def cluster(folder: Path) -> Iterator[dict[str, str]]:
    """Runs while the context lasts; gives the environment in which `sbatch` and its kin find it."""
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o755)  # munged insists
    key = folder / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
    config = folder / "slurm.conf"
    config.write_text(
        CONFIG.format(folder=folder, host=socket.gethostname().split(".")[0], user=user, ports=_free_ports(2))
    )
    path = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin"))
    environment = {**os.environ, "PATH": path, "SLURM_CONF": str(config)}
    munged = [
        "munged", "--foreground", "--force", f"--socket={folder}/munge.socket", f"--key-file={key}",
        f"--pid-file={folder}/munged.pid", f"--log-file={folder}/munged.log", f"--seed-file={folder}/munged.seed",
    ]  # fmt: skip
    daemons: list[subprocess.Popen[bytes]] = []
    try:
        with (folder / "daemons.log").open("ab") as log:
            for command in (munged, ["slurmctld", "-D", "-f", str(config)], ["slurmd", "-D", "-f", str(config)]):
                daemons.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
                if command is munged:
                    wait_for((folder / "munge.socket").exists, 20, LOGS)

        def idle() -> bool:
            command = ["sinfo", "--noheader", "--format=%t"]
            answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            return answer.stdout.strip() == "idle"

        wait_for(idle, 60, LOGS)
        try:
            yield environment
        finally:
            subprocess.run(["scancel", f"--user={user}"], env=environment, check=True)  # what a failure left
            wait_for(idle, 60, LOGS)  # else what ends the last job would look for a controller that is gone
    finally:
        for daemon in reversed(daemons):
            daemon.terminate()
        for daemon in reversed(daemons):
            try:
                daemon.wait(20)
            except subprocess.TimeoutExpired:
                daemon.kill()


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for s in sockets:
            s.bind(("127.0.0.1", 0))
        return [s.getsockname()[1] for s in sockets]
    finally:
        for s in sockets:
            s.close()
