"""What a run keeps of its own training, beside its checkpoints."""

import json
import signal
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import msgspec
import pytest
from helpers.small_trainings import train_small_model

from aenerf_ns.errors import DataError
from aenerf_ns.report.run_files import read_record, read_scalars
from aenerf_ns.training import provenance
from aenerf_ns.training.run_record import ScalarWriter
from aenerf_ns.training.trainer import AENeRFTrainer


def test_a_command_is_recorded_without_the_folders_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["/home/a/b/c/bench", "--work=/a/b", "poses=/a/b", "a/b=c"]
    monkeypatch.setattr(sys, "argv", ["benchmarks/paper/__main__.py", *arguments])
    for name in ("benchmarks.paper.__main__", "benchmarks.paper"):
        monkeypatch.setattr(sys.modules["__main__"], "__spec__", ModuleSpec(name, None))
        shortened = ".../b/c/bench --work=.../a/b poses=.../a/b a/b=c"
        assert provenance.provenance()["command"] == f"python -m benchmarks.paper {shortened}"


def test_a_commit_is_that_of_this_package_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    git = ("git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b")
    module = tmp_path / "package" / "provenance.py"
    module.parent.mkdir()
    module.write_text("")
    monkeypatch.setattr(provenance, "__file__", str(module))
    assert provenance.provenance()["commit"] is None
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message", "of something else"], check=True)
    assert provenance.provenance()["commit"] is None
    subprocess.run([*git, "add", "package"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--message", "of this"], check=True)
    commit = provenance.provenance()["commit"]
    assert len(commit) == 7
    module.write_text("changed")
    assert provenance.provenance()["commit"] == f"{commit}+changes"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance.provenance()["commit"] is None


def test_a_training_records_its_end_and_its_scalars(tmp_path: Path) -> None:
    folder = train_small_model(tmp_path, "whole", 12).base_dir
    record, scalars = read_record(folder), read_scalars(folder)
    assert msgspec.to_builtins(record) == json.loads((folder / "run.json").read_text())
    assert record.describe_state() == "finished: all 12 steps"
    assert (record.first_step, record.steps, record.planned_steps, record.seed) == (0, 12, 12, 42)
    assert record.seconds > 0
    assert record.peak_memory_bytes["host"] > 1e7
    steps, losses = scalars["Train Loss"]
    assert steps == [0, 10]
    assert min(losses) > 0
    assert "Train Loss Dict/reconstruction_loss" in scalars
    assert not any("time" in name for name in scalars)
    # A run of an earlier version has neither.
    assert read_record(tmp_path) is read_scalars(tmp_path) is None


def test_a_run_that_goes_on_in_its_folder_keeps_its_scalars(tmp_path: Path) -> None:
    for steps, resumes in (((0, 10, 20), False), ((10, 30), True)):
        scalars = ScalarWriter(tmp_path, resumes)
        for step in steps:
            scalars.write_scalar("loss", 0.5 + resumes, step)
    # The first part was killed after its checkpoint at step 10.
    assert read_scalars(tmp_path) == {"loss": ([0, 10, 30], [0.5, 1.5, 1.5])}


def test_another_training_in_the_folder_is_refused(tmp_path: Path) -> None:
    ScalarWriter(tmp_path, resumes=False).write_scalar("loss", 0.5, 0)
    owner = "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.lockf(f, fcntl.LOCK_EX); print(flush=True); input()"
    command = [sys.executable, "-c", owner, tmp_path / "scalars.csv"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(DataError, match="another training writes there; give another --experiment-name"):
            ScalarWriter(tmp_path, resumes=False)
        other.kill()
    assert read_scalars(tmp_path) == {"loss": ([0], [0.5])}
    ScalarWriter(tmp_path, resumes=False).write_scalar("loss", 0.25, 0)
    assert read_scalars(tmp_path) == {"loss": ([0], [0.25])}


def test_one_of_several_processes_does_not_wait_for_a_checkpoint() -> None:
    trainer = object.__new__(AENeRFTrainer)
    trainer.world_size = 2
    before = signal.getsignal(signal.SIGTERM)
    with trainer._stopping_after_a_step():
        assert signal.getsignal(signal.SIGTERM) is before
