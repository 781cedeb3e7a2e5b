"""The ablation through a real Slurm, then jobs that are taken away: `python -m tests.slurm.ablation_and_requeue FOLDER`.

Starts a cluster of this one machine in FOLDER and runs the four rows of the ablation on the tiny demo with
`hydra/launcher=submitit_slurm`. Then one longer run four times: undisturbed and without Slurm; as a job that `scontrol requeue`
takes away; as one that is killed; as one that runs into its time limit. All must leave the same point cloud, byte for byte. What
happens is printed, also to FOLDER/log.txt.
"""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
import time
from pathlib import Path

from tests.helpers.command_line import ROOT, TINY, wait_for
from tests.slurm.one_machine import cluster

DEMO = [override for override in TINY if not override.startswith("fit.iterations=")]
# What a user writes to go from this machine to a cluster.
SLURM = ["-m", "hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=1", "fit.resume=auto"]
ABLATION = [*SLURM, "+strategy=baseline,gco,[gco,p2g],clear", "hydra.sweep.dir=ablation", "fit.iterations=300", *DEMO]
LONG = ["+strategy=clear", "fit.iterations=6000", *DEMO]

_log = logging.getLogger("slurm")


class Experiment:
    """The commands, in one folder and one environment."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder = folder
        self.environment = {
            **environment,
            "PYTHONPATH": os.pathsep.join((str(ROOT), environment.get("PYTHONPATH", ""))).rstrip(os.pathsep),
            "CLEAR_CACHE": str(folder / "cache"),
        }

    def start(self, *overrides: str, name: str) -> subprocess.Popen[bytes]:
        """`python -m clear_strategies.run` with the overrides; what it says goes to `name`.txt."""
        command = [sys.executable, "-m", "clear_strategies.run", *overrides]
        said = " ".join(o for o in overrides if o not in DEMO)
        _log.info("$ python -m clear_strategies.run %s   (the tiny demo)", said)
        with (self.folder / f"{name}.txt").open("wb") as output:
            return subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=output, stderr=output)

    def finish(self, process: subprocess.Popen[bytes], name: str, expected: int = 0) -> None:
        code = process.wait(900)
        if code != expected:
            raise RuntimeError(f"{name} ended with {code}:\n{(self.folder / f'{name}.txt').read_text()[-3000:]}")

    def ask(self, *command: str) -> str:
        result = subprocess.run(
            command, cwd=self.folder, env=self.environment, capture_output=True, text=True, check=False
        )
        return (result.stdout + result.stderr).strip()

    def show(self, *command: str) -> None:
        _log.info("$ %s\n%s", " ".join(command), self.ask(*command))

    def ablation(self) -> None:
        """Table 4's rows, two jobs at once on two cores."""
        process = self.start(*ABLATION, name="ablation")
        wait_for(lambda: self.ask("squeue", "-h", "-t", "R").count("\n") >= 1, 300, "two jobs to run")
        self.show("squeue")
        self.finish(process, "ablation")
        if len(list(self.folder.glob("ablation/*/metrics.json"))) != 4:
            raise AssertionError("not every job of the ablation finished")

    def undisturbed(self) -> bytes:
        process = self.start("hydra.run.dir=undisturbed", *LONG, "fit.threads=1", name="undisturbed")
        self.finish(process, "undisturbed")
        return (self.folder / "undisturbed" / "point_cloud.ply").read_bytes()

    def requeued(self, expected: bytes) -> None:
        """An operator, or a job of higher priority, takes the job away in the middle."""
        process = self.start(*SLURM, *LONG, "hydra.sweep.dir=requeued", name="requeued")
        log = self.folder / "requeued" / "0" / "run.log"
        wait_for(lambda: log.exists() and "GCO is" in log.read_text(), 300, "training")
        time.sleep(3)
        job = self.ask("squeue", "-h", "-t", "R", "-o", "%i").split()[0]
        self.show("scontrol", "requeue", job)
        time.sleep(2)
        self.show("squeue")
        self.finish(process, "requeued")
        self.compare("requeued", expected)

    def killed(self, expected: bytes) -> None:
        """As a failing node would: the process is gone without a word, and the job is started again."""
        process = self.start(*SLURM, *LONG, "hydra.sweep.dir=killed", name="killed")
        folder = self.folder / "killed" / "0"
        wait_for(lambda: list(folder.glob("checkpoints/step_*.safetensors")), 300, "a checkpoint")
        job = self.ask("squeue", "-h", "-t", "R", "-o", "%i").split()[0]
        self.show("scancel", "--signal=KILL", "--full", job)
        wait_for(lambda: not self.ask("squeue", "-h", "-t", "R"), 300, "the job to end")
        self.show("scontrol", "requeue", job)
        self.finish(process, "killed")
        self.compare("killed", expected)

    def timed_out(self, expected: bytes) -> None:
        """The time limit is shorter than the run; before it Slurm sends SIGUSR2, as submitit asked it to."""
        limits = {"timeout_min": 1, "signal_delay_s": 30, "max_num_timeout": 20}
        asked = (f"hydra.launcher.{name}={value}" for name, value in limits.items())
        process = self.start(*SLURM, *asked, *LONG, "hydra.sweep.dir=timed_out", name="timed_out")
        self.finish(process, "timed_out")
        for path in sorted((self.folder / "timed_out" / ".submitit").rglob("*_log.out")):
            _tell(path, r"submitit (WARNING|INFO).*(Caught signal|Requeued|completed)")
        self.compare("timed_out", expected)

    def compare(self, name: str, expected: bytes) -> None:
        folder = self.folder / name / "0"
        _tell(folder / "run.log", r"finishing this step|stopped by|resumed from|done in")
        if "resumed from" not in (folder / "run.log").read_text():
            raise AssertionError(f"{name}: the run was never resumed, so nothing was shown")
        if (folder / "point_cloud.ply").read_bytes() != expected:
            raise AssertionError(f"{name}: the point cloud is not that of the undisturbed run")
        seconds = json.loads((folder / "metrics.json").read_text())["seconds"]
        _log.info(
            "%s/0/point_cloud.ply is, byte for byte, that of the undisturbed run (%.0f s of training).", name, seconds
        )


def _tell(path: Path, pattern: str) -> None:
    lines = [line for line in path.read_text(errors="replace").splitlines() if re.search(pattern, line)]
    _log.info("%s says\n%s", path.name, "\n".join(f"  {line.strip()}" for line in lines))


def main(folder: Path) -> None:
    """Everything, into the folder; raises where something is not as it should be."""
    folder.mkdir(parents=True, exist_ok=True)
    handlers = [logging.StreamHandler(sys.stdout), logging.FileHandler(folder / "log.txt", "w")]
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S", handlers=handlers)
    with cluster(folder / "cluster") as environment:
        experiment = Experiment(folder, environment)
        experiment.show("sbatch", "--version")
        experiment.show("sinfo")
        experiment.ablation()
        expected = experiment.undisturbed()
        experiment.requeued(expected)
        experiment.killed(expected)
        experiment.timed_out(expected)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
