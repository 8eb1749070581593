"""The job array of the documentation under SLURM: a cluster of one node, on loopback."""

import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest
from command import run_command

from jaxslam import store

PROGRAMS = ("munged", "mungekey", "slurmctld", "slurmd", "sbatch", "squeue", "scancel")
SCRIPT = Path(__file__).parents[3] / "examples" / "slurm_campaign.sh"
ASKED = ["--scenario", "circle", "--filters", "dead_reckoning", "--steps", "12", "--block", "2"]
RUNS = ["--runs", "32"]

pytestmark = [
    pytest.mark.sweep,
    pytest.mark.skipif(
        not all(shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") for name in PROGRAMS),
        reason="SLURM or munge is not installed (Debian: slurm-wlm, munge)",
    ),
    pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root"),
]

CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=8000 State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""

# Part 2 hangs, so that it can be cancelled as it runs.
COMMAND = """#!/bin/sh
case "$*" in *"--part 2/"*) sleep 900 ;; esac
exec {python} -m jaxslam "$@"
"""


def free_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def until(true, seconds):
    """Wait until a function returns something true, and return it."""
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.3)
    return found


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """A function that calls a command of SLURM and returns what it printed."""
    folder = tmp_path_factory.mktemp("slurm")
    host = socket.gethostname().partition(".")[0]
    text = CONFIGURATION.format(folder=folder, host=host, ports=(free_port(), free_port()))
    (folder / "slurm.conf").write_text(text)
    for name in ("state", "spool", "bin"):
        (folder / name).mkdir()
    (folder / "bin" / "jaxslam").write_text(COMMAND.format(python=sys.executable))
    (folder / "bin" / "jaxslam").chmod(0o755)
    path = f"{folder / 'bin'}:{os.environ['PATH']}:/usr/sbin"
    env = os.environ | {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": path}
    subprocess.run(["mungekey", f"--keyfile={folder}/key"], check=True, env=env)
    services = [
        ["munged", "--foreground", "--force", f"--socket={folder}/munge.socket"]
        + [f"--key-file={folder}/key", f"--log-file={folder}/munge.log"]
        + [f"--pid-file={folder}/munge.pid", f"--seed-file={folder}/seed"],
        ["slurmctld", "-D"],
        ["slurmd", "-D", "-N", host],
    ]

    def call(*command, cwd=None):
        ran = subprocess.run(command, env=env, cwd=cwd, capture_output=True, text=True)
        return ran.stdout.strip()

    started = []
    with (folder / "services.log").open("wb") as log:
        for service in services:
            started.append(subprocess.Popen(service, env=env, stdout=log, stderr=log))
            time.sleep(1)
    try:
        until(lambda: "idle" in call("sinfo", "-h", "-o", "%T"), 60)
        yield call
    finally:
        call("scancel", "--full", "--user=root")
        for service in reversed(started):
            service.terminate()
            service.wait(30)


def test_the_job_array_sums_to_the_same_bits_though_a_task_is_cancelled(slurm, tmp_path):
    jax.devices()  # before the command can ask for another number of them
    assert (
        run_command(
            ["consistency", *ASKED, *RUNS, "--devices", "1", "--out", str(tmp_path / "whole")]
        )
        == 0
    )
    job = slurm("sbatch", "--parsable", "--cpus-per-task=1", SCRIPT, *ASKED, *RUNS, cwd=tmp_path)
    summing = ["--parsable", f"--dependency=afterany:{job}", "--mem-per-cpu=1G"]
    wrapped = f"jaxslam consistency --resume {tmp_path}/campaign --figures=svg"
    last = slurm("sbatch", *summing, f"--wrap={wrapped}", cwd=tmp_path)
    running = ("squeue", "-h", "-t", "R", "-j", job, "-o", "%i")
    # One is cancelled as it runs, after others are done.
    until(lambda: list((tmp_path / "campaign" / "blocks").glob("block-*")), 240)
    until(lambda: f"{job}_2" in slurm(*running).split(), 60)
    slurm("scancel", f"{job}_2")
    until(lambda: last not in slurm("squeue", "-h", "-o", "%i").split(), 600)
    blocks = store.resume(tmp_path / "campaign" / "blocks")
    assert blocks.done() == 32 and len(blocks.spans()) == 16
    curves = (tmp_path / "campaign" / "consistency.csv").read_text()
    assert curves == (tmp_path / "whole" / "consistency.csv").read_text()
    said = {path.stem.rpartition("_")[2]: path.read_text() for path in tmp_path.glob("slurm-*_*")}
    assert len(said) == 16 and "CANCELLED" in said.pop("2")
    assert not [text for text in said.values() if "is done" not in text]
