"""Checkpoints: whole or not at all, and a broken one blocks nothing."""

import errno
import os
import pickle
import re
import resource
import shutil
import signal
import stat
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from helpers.dataset_faults import rewrite_zip, zip_members
from helpers.small_trainings import train_small_model
from nerfstudio.utils.eval_utils import eval_setup

from aenerf_ns.atomic_write import atomic_write
from aenerf_ns.errors import DataError
from aenerf_ns.training.checkpoints import checkpoint_to_load
from aenerf_ns.training.trainer import AENeRFTrainer


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> AENeRFTrainer:
    """A run with the checkpoints of steps 2 and 3."""
    folder = tmp_path_factory.mktemp("trained")
    return train_small_model(folder, "run", 4, steps_per_save=2, save_only_latest_checkpoint=False)


@pytest.fixture
def run(trained: AENeRFTrainer, tmp_path: Path) -> Path:
    """A copy of the run's folder."""
    folder = tmp_path / "run" / "aenerf" / "now"
    shutil.copytree(trained.base_dir, folder)
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir = tmp_path
    (folder / "config.yml").write_text(yaml.dump(config))
    return folder


class _Code:
    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, ("touch executed",)


def _truncated(share: float) -> Callable[[Path], None]:
    return lambda path: os.truncate(path, int(share * path.stat().st_size))


def _flip(path: Path) -> None:
    contents = bytearray(path.read_bytes())
    contents[len(contents) // 2] ^= 1
    path.write_bytes(contents)


def _replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _compress(path: Path) -> None:
    rewrite_zip(path, zip_members(path), zipfile.ZIP_DEFLATED)


def _with(**entries: object) -> Callable[[Path], None]:
    return lambda path: torch.save({**torch.load(path, weights_only=False), **entries}, path)


def _archive_of(pickled: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickled)
            archive.writestr("archive/version", b"3\n")

    return write


FAULTS: dict[str, Callable[[Path], Any]] = {
    "empty": _truncated(0),
    "half": _truncated(0.5),
    "nearly whole": _truncated(0.999),
    "a flipped bit": _flip,
    "text": lambda path: path.write_text("a checkpoint"),
    "a folder": _replace_by_folder,
    "a pickle": lambda path: path.write_bytes(pickle.dumps({"step": 3})),
    "something else's": lambda path: torch.save({"weights": torch.zeros(3)}, path),
    "code": lambda path: torch.save({"step": _Code(), "pipeline": {}}, path),
    "compressed": _compress,
    "a step of text": _with(step="three"),
    "a negative step": _with(step=-5),
    "weights in a list": _with(pipeline=[]),
    "a pickle that takes what is not there": _archive_of(b"\x80\x02h\x05."),
    "a pickle without its end": _archive_of(b"\x80\x02}"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_newest_checkpoint_is_named_and_passed_over(
    run: Path, fault: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    folder = (run / "nerfstudio_models").rename(run / "[models]")
    newest = folder / "step-000000003.ckpt"
    assert checkpoint_to_load(folder) == newest
    assert capsys.readouterr().out == ""
    FAULTS[fault](newest)
    with warnings.catch_warnings():
        # A warning of torch would print a second line.
        warnings.simplefilter("error")
        assert checkpoint_to_load(folder) == folder / "step-000000002.ckpt"
    said = capsys.readouterr().out
    assert said.count("\n") == 1
    assert said.startswith(f"{folder}: broken checkpoints: {newest.name} (")
    assert said.endswith("). step-000000002.ckpt is loaded\n")
    # Both options: the broken one may have been named by either, or by --load-checkpoint.
    remedy = re.escape(f"load step-000000002.ckpt (--load-dir '{folder}' --load-step 2)")
    for path, step in ((folder, 3), (newest, None)):
        with pytest.raises(DataError, match=f"step-000000003.ckpt: .*; {remedy}$"):
            checkpoint_to_load(path, step)
    assert not (run / "executed").exists()


def test_a_checkpoint_that_is_not_there_is_one_line(run: Path, tmp_path: Path) -> None:
    folder = run / "nerfstudio_models"
    with pytest.raises(DataError, match=r"step-000000009.ckpt: .*No such file.*--load-step 3"):
        # The folder of the run holds that of the checkpoints.
        checkpoint_to_load(run, 9)
    with pytest.raises(DataError, match="nothing: there is no such folder"):
        checkpoint_to_load(tmp_path / "nothing")
    for path in folder.iterdir():
        _truncated(0.5)(path)
    with pytest.raises(DataError, match=r"none of its checkpoints is whole: .*3.ckpt \(.*; .*2.ckpt \("):
        checkpoint_to_load(folder)
    shutil.rmtree(folder)
    folder.mkdir()
    with pytest.raises(DataError, match="it holds no checkpoint; give the folder of another run"):
        checkpoint_to_load(folder)


def test_what_lies_around_a_checkpoint_leads_to_it(run: Path, tmp_path: Path) -> None:
    folder = run / "nerfstudio_models"
    (run / "config.yml").touch()
    assert checkpoint_to_load(run / "config.yml") == folder / "step-000000003.ckpt"
    assert checkpoint_to_load(folder / "step-000000002.ckpt") == folder / "step-000000002.ckpt"
    with pytest.raises(DataError, match="it is not the checkpoint of step 3"):
        checkpoint_to_load(folder / "step-000000002.ckpt", 3)
    copied = shutil.copyfile(folder / "step-000000002.ckpt", run / "best.pth")
    assert checkpoint_to_load(copied) == copied
    with pytest.raises(DataError, match=r"step-5.ckpt: .*\(No such file or directory\); give the folder of another"):
        checkpoint_to_load(run / "step-5.ckpt")
    method = tmp_path / "experiment" / "aenerf"
    shutil.copytree(run, method / "now")
    for above in (method, method.parent):
        with pytest.raises(DataError, match=f"{above}: it holds no checkpoint; give a run: {method}/now"):
            checkpoint_to_load(above)


def test_a_run_is_opened_with_its_newest_whole_checkpoint(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # What ns-eval, ns-render, ns-export and ns-viewer call.
    assert eval_setup(run / "config.yml")[3] == 3
    (run / "nerfstudio_models" / "notes.txt").write_text("of no interest")
    _truncated(0.5)(run / "nerfstudio_models" / "step-000000003.ckpt")
    assert eval_setup(run / "config.yml")[3] == 2
    assert "step-000000002.ckpt is loaded" in capsys.readouterr().out
    _truncated(0.5)(run / "nerfstudio_models" / "step-000000002.ckpt")
    with pytest.raises(SystemExit, match=r"^Error: \S+nerfstudio_models: none of its checkpoints is whole: .*again$"):
        eval_setup(run / "config.yml")


@pytest.mark.parametrize("words", ["--load-config {}", "--load-config={}"])
def test_a_command_of_nerfstudio_finds_the_folder_of_its_run(
    words: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = run.rename(tmp_path / "lr=0.01")
    monkeypatch.setattr(sys, "argv", ["ns-eval", *words.format(moved / "config.yml").split()])
    assert eval_setup(moved / "config.yml")[2] == moved / "nerfstudio_models" / "step-000000003.ckpt"


def test_a_run_goes_on_from_the_newest_whole_checkpoint(
    run: Path, tmp_path: Path, trained: AENeRFTrainer, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = run / "nerfstudio_models"
    (tmp_path / "data").symlink_to(trained.config.output_dir / "data")
    _truncated(0.5)(folder / "step-000000003.ckpt")
    resumed = train_small_model(tmp_path, "resumed", 2, load_dir=folder)
    assert "step-000000002.ckpt is loaded" in capsys.readouterr().out
    assert [path.name for path in resumed.checkpoint_dir.iterdir()] == ["step-000000004.ckpt"]
    with pytest.raises(SystemExit, match=r"^Error: .*step-000000003.ckpt: .*--load-step 2\)$"):
        train_small_model(tmp_path, "refused", 2, load_checkpoint=folder / "step-000000003.ckpt")
    # A run that was told the step opens as every other.
    for option in ("load_dir", "load_checkpoint"):
        told = train_small_model(tmp_path, f"told by {option}", 2, load_step=2, **{option: run})
        assert eval_setup(told.base_dir / "config.yml")[3] == 4
    with pytest.raises(SystemExit, match=r"^Error: ns-train: --load-step 2 names no run; give the run with --load-dir"):
        train_small_model(tmp_path, "refused", 2, load_step=2)


def test_a_training_beside_later_checkpoints_of_another_one_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = train_small_model(tmp_path, "run", 4, steps_per_save=2, save_only_latest_checkpoint=False)
    assert "of another training" not in capsys.readouterr().out
    # In the same folder.
    resumed = {"load_dir": first.base_dir, "save_only_latest_checkpoint": False}
    train_small_model(tmp_path, "run", 1, **resumed)
    assert "of another training" not in capsys.readouterr().out
    train_small_model(tmp_path, "run", 1, load_step=2, **resumed)
    said = f"{first.checkpoint_dir}: step-000000004.ckpt is of another training. While it is the newest, the run opens"
    assert said in capsys.readouterr().out
    # The newer model stays, whatever a training from the beginning saves.
    train_small_model(tmp_path, "run", 2)
    names = sorted(path.name for path in first.checkpoint_dir.iterdir())
    assert names == ["step-000000001.ckpt", "step-000000002.ckpt", "step-000000003.ckpt", "step-000000004.ckpt"]


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let no file grow beyond ``size`` bytes, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_checkpoint_that_cannot_be_written_leaves_the_older_one(
    trained: AENeRFTrainer, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run / "nerfstudio_models"
    monkeypatch.setattr(trained, "checkpoint_dir", folder)
    monkeypatch.setattr(trained, "base_dir", run)
    files = sorted(run.rglob("*"))
    size = (folder / "step-000000003.ckpt").stat().st_size
    # From the first bytes to the last ones of the archive's directory.
    for limit in (0, 100, size // 3, size - 10_000, size - 1):
        with files_of_at_most(limit), pytest.raises(SystemExit, match=r"^Error: \S+step-000000009.ckpt: .*--load-dir"):
            trained.save_checkpoint(9)
        assert sorted(run.rglob("*")) == files
    trained.save_checkpoint(9)
    assert checkpoint_to_load(folder).name == "step-000000009.ckpt"


def test_a_run_that_is_killed_while_it_writes_leaves_whole_checkpoints(
    trained: AENeRFTrainer, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(_: object, path: Path) -> None:
        path.write_bytes(b"PK")
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(trained, "checkpoint_dir", run / "nerfstudio_models")
    monkeypatch.setattr(trained, "base_dir", run)
    monkeypatch.setattr(torch, "save", killed)
    child = os.fork()
    if child == 0:
        try:
            trained.save_checkpoint(9)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert eval_setup(run / "config.yml")[3] == 3


def test_a_file_system_that_cannot_sync_a_folder_takes_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sync = os.fsync

    def of_files_only(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", of_files_only)
    with atomic_write(tmp_path / "config.yml") as partial:
        partial.write_text("newer")
    assert (tmp_path / "config.yml").read_text() == "newer"
