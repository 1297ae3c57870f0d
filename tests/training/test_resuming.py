"""Trainings that resume from a checkpoint."""

import inspect
import json
import os
import re
import signal
import textwrap
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.small_trainings import train_small_model
from nerfstudio.engine import trainer as framework_trainer
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.eval_utils import eval_setup
from torch.utils._pytree import keystr, tree_flatten_with_path

from aenerf_ns.report.run_files import read_scalars
from aenerf_ns.training.datamanager import EventDataManager
from aenerf_ns.training.trainer import AENeRFTrainer

NUM_STEPS = 60
# Not a multiple of the 8 steps over which gradients of the poses are accumulated. Odd, because the proposal networks
# are trained at every other step. And in the part of the run in which the field's warp counts rays.
NUM_FIRST = 13


def checkpoint(trainer: AENeRFTrainer) -> dict[str, Any]:
    (path,) = trainer.checkpoint_dir.glob("*.ckpt")
    return torch.load(path, weights_only=True)


def assert_equal(first: Any, second: Any) -> None:
    """Assert that two checkpoints hold the same values to the bit."""
    ours, theirs = (
        {keystr(path): leaf for path, leaf in tree_flatten_with_path(checkpoint)[0]} for checkpoint in (first, second)
    )
    assert ours.keys() == theirs.keys()
    for name, one in ours.items():
        assert type(one) is type(theirs[name]), name
        assert torch.equal(one, theirs[name]) if isinstance(one, torch.Tensor) else one == theirs[name], name


def test_run_in_two_pieces_equals_one(tmp_path: Path) -> None:
    whole = checkpoint(train_small_model(tmp_path, "whole", NUM_STEPS))
    first = train_small_model(tmp_path, "first", NUM_FIRST, schedule_length=NUM_STEPS)
    # The second piece is another process, whose generators are elsewhere.
    second = train_small_model(tmp_path, "second", NUM_STEPS - NUM_FIRST, seed=7, load_dir=first.checkpoint_dir)
    assert second.config.schedule_length == NUM_STEPS
    resumed = checkpoint(second)
    assert_equal(whole, resumed)
    assert whole["pipeline"]["_model.camera_optimizer.twists.control_twists"].any()
    assert checkpoint(first)["pipeline"]["training_state._extra_state"]["gradients"]["camera_opt"][0].any()
    # Of a version with other groups of parameters.
    (path,) = first.checkpoint_dir.iterdir()
    contents = checkpoint(first)
    contents["optimizers"]["networks"]["param_groups"][0]["params"].append(99)
    torch.save(contents, path)
    with pytest.raises(SystemExit, match=r"^Error: \S+\.ckpt: it holds other parameters than this training: .*again$"):
        train_small_model(tmp_path, "other", 1, load_dir=first.checkpoint_dir)


def test_a_checkpoint_with_a_scene_elsewhere_is_refused(tmp_path: Path) -> None:
    first = train_small_model(tmp_path, "first", 1)
    path = tmp_path / "data" / "trajectory_estimated.txt"
    # Training scales the poses to one unit.
    path.write_text(path.read_text().replace("0.10000000149", "0.2"))
    line = r"^Error: \S+data: its scene is scaled, .*: 5, there 10\); give the dataset"
    with pytest.raises(SystemExit, match=line):
        train_small_model(tmp_path, "second", 1, load_dir=first.checkpoint_dir)
    with pytest.raises(SystemExit, match=line):
        eval_setup(first.base_dir / "config.yml")


def test_a_checkpoint_whose_weights_would_show_another_scene_is_refused(tmp_path: Path) -> None:
    """Grids of other resolutions have as many weights."""
    first = train_small_model(tmp_path, "first", 1)
    config = first.config.pipeline
    config.model.field.max_resolution = 48
    line = r"^Error: model: field.max_resolution is 48, and 32 in the checkpoint; give the method and the options"
    with pytest.raises(SystemExit, match=line):
        train_small_model(tmp_path, "second", 1, pipeline=config, load_dir=first.checkpoint_dir)


@pytest.mark.parametrize("counts_earlier_steps", [False, True])
def test_resumed_run_reaches_its_last_step(
    counts_earlier_steps: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The installed Nerfstudio and its main branch count the steps of a resumed run differently."""
    first = train_small_model(tmp_path, "first", 10)
    if counts_earlier_steps:
        number = "num_iterations = self.config.max_num_iterations\n"
        source = textwrap.dedent(inspect.getsource(Trainer.train))
        assert source.count(number) == 1
        file = tmp_path / "train.py"
        file.write_text(source.replace(number, f"{number.strip()} - self._start_step\n"))
        namespace = dict(vars(framework_trainer))
        exec(compile(file.read_text(), file, "exec"), namespace)
        monkeypatch.setattr(Trainer, "train", namespace["train"])
    capsys.readouterr()
    count = 25 if counts_earlier_steps else 15
    resumed = train_small_model(tmp_path, "second", count, load_checkpoint=first.checkpoint_dir / "step-000000009.ckpt")
    shown = re.findall(r"^(\d+) \((\d+)\.00%\)", capsys.readouterr().out, re.MULTILINE)
    assert shown == [("10", "40"), ("20", "80")]
    (path,) = resumed.checkpoint_dir.iterdir()
    assert path.name == "step-000000024.ckpt"
    # What is made at the last step.
    assert checkpoint(resumed)["pipeline"]["_extra_state"]["summary"]
    record = json.loads((resumed.base_dir / "run.json").read_text())
    assert [record[name] for name in ("state", "first_step", "steps", "planned_steps")] == ["finished", 10, 15, 15]
    if counts_earlier_steps:
        with pytest.raises(SystemExit, match=r"^Error: ns-train: the checkpoint is of step 24; "):
            train_small_model(tmp_path, "third", 25, load_dir=resumed.checkpoint_dir)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> AENeRFTrainer:
    return train_small_model(tmp_path_factory.mktemp("uninterrupted"), "whole", 12, steps_per_eval_batch=5)


# The training evaluates a batch at steps 5 and 10, which draws random numbers, and logs step 10. Step 11 is the last.
@pytest.mark.parametrize(("number", "asked_in"), [(signal.SIGINT, 5), (signal.SIGTERM, 10), (signal.SIGINT, 11)])
def test_a_training_that_is_asked_to_stop_leaves_a_checkpoint(
    number: signal.Signals,
    asked_in: int,
    uninterrupted: AENeRFTrainer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    step = AENeRFTrainer.train_iteration

    def asked(self: AENeRFTrainer, index: int) -> object:
        if index == asked_in:
            os.kill(os.getpid(), number)
        return step(self, index)

    def train(num_steps: int, **options: Any) -> AENeRFTrainer:
        return train_small_model(tmp_path, "asked", num_steps, steps_per_eval_batch=5, **options)

    before = signal.getsignal(number)
    left = 11 - asked_in
    with monkeypatch.context() as patch:
        patch.setattr(AENeRFTrainer, "train_iteration", asked)
        if left == 0:
            # It ends by itself.
            assert_equal(checkpoint(uninterrupted), checkpoint(train(12)))
            return
        with pytest.raises(SystemExit) as stopped:
            train(12)
    assert stopped.value.code == 128 + number
    assert signal.getsignal(number) is before
    (file,) = tmp_path.rglob("run.json")
    record = json.loads(file.read_text())
    assert (record["state"], record["steps"]) == ("stopped", asked_in + 1)
    assert read_scalars(file.parent)["Train Loss"][0] == [0, 10][: 1 + asked_in // 10]
    assert read_scalars(file.parent)["Eval Loss"][0] == [5, 10][: asked_in // 5]
    said = capsys.readouterr().out
    assert f"Stopped after step {asked_in}. Go on with the same command" in said
    options = f"--load-dir {file.parent} --load-step {asked_in} --max-num-iterations {left}"
    assert f"{options} after the method's name, in place" in said
    assert_equal(checkpoint(uninterrupted), checkpoint(train(left, load_dir=file.parent)))


def test_a_schedule_that_began_anew_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The options of the resumed command stay, but for those that the training names when it stops."""
    first = train_small_model(tmp_path, "first", 4)
    anew = {"load_dir": first.base_dir, "load_step": 3, "load_scheduler": False}
    whole = train_small_model(tmp_path, "second", 9, **anew)
    with pytest.raises(SystemExit):
        train_small_model(
            tmp_path, "asked", 9, prepare=lambda trainer: setattr(trainer, "_stopped_by", signal.SIGINT), **anew
        )
    said = re.search(r"and --load-dir (\S+) --load-step 4 --max-num-iterations 8 (.*) after", capsys.readouterr().out)
    assert said is not None
    assert said[2] == "--load-scheduler True"
    named = {"load_dir": Path(said[1]), "load_step": 4, "load_scheduler": True}
    assert_equal(checkpoint(whole), checkpoint(train_small_model(tmp_path, "third", 8, **named)))


def test_a_new_schedule_begins_with_its_own_rates(tmp_path: Path) -> None:
    """The optimizers' states have the last rates of the old one."""
    first = train_small_model(tmp_path, "first", 6)
    assert first.optimizers.optimizers["camera_opt"].param_groups[0]["lr"] > 0
    rates = []

    def note(trainer: AENeRFTrainer) -> None:
        rates.extend(optimizer.param_groups[0]["lr"] for optimizer in trainer.optimizers.optimizers.values())

    train_small_model(tmp_path, "whole", 1, prepare=note)
    train_small_model(tmp_path, "second", 1, prepare=note, load_dir=first.base_dir, load_scheduler=False)
    count = len(rates) // 2
    assert rates[:count] == rates[count:]


def test_a_training_that_is_asked_twice_stops_at_once(tmp_path: Path) -> None:
    def ask_in_a_step(trainer: AENeRFTrainer) -> None:
        step = trainer.train_iteration

        def asked(index: int) -> object:
            if index == 2:
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGTERM)
            return step(index)

        trainer.train_iteration = asked  # type: ignore[method-assign]

    # Nerfstudio's launcher makes a traceback and success of a KeyboardInterrupt.
    with pytest.raises(SystemExit) as stopped:
        train_small_model(tmp_path, "asked", 12, prepare=ask_in_a_step)
    assert stopped.value.code == 128 + signal.SIGTERM
    assert not list(tmp_path.rglob("*.ckpt"))
    (file,) = tmp_path.rglob("run.json")
    assert json.loads(file.read_text())["state"] == "stopped"


def test_a_training_that_is_asked_to_stop_while_it_is_set_up_stops_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # While the events are read, which may take minutes.
    monkeypatch.setattr(EventDataManager, "supervise", lambda *_: os.kill(os.getpid(), signal.SIGINT))
    # Commands that a shell starts in the background ignore the signal, and so would the tests.
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as stopped:
            train_small_model(tmp_path, "asked", 12)
    finally:
        signal.signal(signal.SIGINT, previous)
    assert stopped.value.code == 128 + signal.SIGINT
    assert capsys.readouterr().out.endswith("\nStopped.\n")


def test_a_training_that_is_asked_to_stop_before_its_first_step_takes_it(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        train_small_model(tmp_path, "asked", 12, prepare=lambda trainer: setattr(trainer, "_stopped_by", signal.SIGINT))
    assert [path.name for path in tmp_path.rglob("*.ckpt")] == ["step-000000000.ckpt"]
