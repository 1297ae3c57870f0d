"""What a config.yml may name, before it is opened."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from helpers.small_trainings import train_small_model

from aenerf_ns.cli.config_safety import require_known_names
from aenerf_ns.cli.evaluate import Evaluate
from aenerf_ns.cli.export import ExportCameras, ExportFrames, ExportMesh, ExportTrajectory, ExportVideo
from aenerf_ns.cli.main import main
from aenerf_ns.cli.report import ReportCommand
from aenerf_ns.cli.trained_run import _at_its_place, open_run
from aenerf_ns.dataparsers.formats import FORMATS
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.method_configs.aenerf import aenerf, aenerf_small
from aenerf_ns.method_configs.aenerf_mlp import aenerf_mlp, aenerf_mlp_small
from aenerf_ns.method_configs.peers import e2vid_nerf, eventnerf, evnerf, paev3d, robust_enerf

METHODS = (aenerf, aenerf_mlp, aenerf_mlp_small, aenerf_small, e2vid_nerf, eventnerf, evnerf, paev3d, robust_enerf)


def report_of_one(run: Path, output: Path) -> ReportCommand:
    """The report of one run, with the arguments of the other commands."""
    return ReportCommand((run,), output)


@pytest.mark.parametrize("config", [*(method.config for method in METHODS), *FORMATS.values()])
def test_configurations_are_known(config: object, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text(yaml.dump(replace(config, data=tmp_path)))
    require_known_names(tmp_path / "config.yml")


def test_members_of_enumerations_are_known_as_python_3_11_2_writes_them(tmp_path: Path) -> None:
    name = f"&x {EVENT_NAME}"
    members = [f"{GETATTR} [{name}, ETA]", f"{GETATTR} [*x, ITER_TRAIN_TIME]"]
    text = f"!!python/object:aenerf_ns.training.trainer.AENeRFTrainerConfig\na: [{', '.join(members)}]"
    (tmp_path / "config.yml").write_text(text)
    require_known_names(tmp_path / "config.yml")


GETATTR, EVENT_NAME = "!!python/object/apply:builtins.getattr", "!!python/name:nerfstudio.utils.writer.EventName ''"
COMMANDS = (Evaluate, ExportTrajectory, ExportCameras, ExportFrames, ExportMesh, ExportVideo, report_of_one)
TOUCH = "!!python/object/apply:os.system ['touch executed']"
HOSTILE = {
    "a call": TOUCH,
    "a call within a run": f"!!python/object:aenerf_ns.training.trainer.AENeRFTrainerConfig\ndata: {TOUCH}",
    "a key": f"? {TOUCH}\n: 1",
    "another handle": "%TAG !h! tag:yaml.org,2002:python/object/apply:\n--- !h!os.system ['touch executed']",
    "a verbatim tag": "!<tag:yaml.org,2002:python/object/apply:os.system> ['touch executed']",
    "new": "!!python/object/new:os.system ['touch executed']",
    "another attribute": f"{GETATTR} [{EVENT_NAME}, mro]",
    "an attribute of another class": f"{GETATTR} [!!python/name:nerfstudio.engine.trainer.Trainer '', train]",
    "an attribute of nothing": f"{GETATTR} [*x, ETA]",
    "an attribute alone": f"{GETATTR} []",
    "an attribute and a call": f"{GETATTR} [{EVENT_NAME}, ETA, {TOUCH}]",
    "a second document": f"a: 1\n--- {TOUCH}",
    "a function": "!!python/name:os.system",
    "a module": "!!python/module:antigravity",
    "a function of the framework": "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch executed']",
    "its name": "!!python/name:nerfstudio.utils.scripts.run_command",
    "a module of the framework": "!!python/name:nerfstudio.utils.scripts.subprocess",
    "another's class in the framework": "!!python/name:nerfstudio.configs.base_config.Path",
    "a class that is called": "!!python/object/apply:nerfstudio.engine.trainer.TrainerConfig {}",
    "torch": "!!python/object/apply:torch.load ['executed']",
    "a package that only begins alike": "!!python/name:nerfstudio_evil.Config",
    "a nameless one": "!!python/object:nerfstudio. {}",
    "what is not there": "!!python/object:nerfstudio.engine.trainer.Nothing {}",
    "a tag of its own": "!run {}",
}


@pytest.mark.parametrize(
    ("command", "text"), [*((command, TOUCH) for command in COMMANDS), *((Evaluate, text) for text in HOSTILE.values())]
)
def test_foreign_names_are_refused(
    command: Callable[..., Evaluate], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("config.yml").write_text(text)
    output = Path("out.mp4" if command is ExportVideo else "out.ply")
    with pytest.raises(DataError, match=r"^config.yml: line \d names .*; give the config.yml of a trained run"):
        command(Path("config.yml"), output=output).main()
    assert not Path("executed").exists()


@pytest.mark.parametrize(
    "text", ["!!python/object:aenerf_ns.trainer.Config {}", "a: !!python/name:aenerf_ns.model.Model"]
)
def test_run_of_another_version_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text(text)
    message = r"line 1 names aenerf_ns\S+, which this version does not have; open it with the version"
    with pytest.raises(DataError, match=message):
        require_known_names(tmp_path / "config.yml")


@pytest.mark.parametrize(
    ("contents", "problem"),
    [
        (b"", "not the config.yml of a run"),
        (b"a: 1", "not the config.yml of a run"),
        (b"a: [1", "it cannot be read"),
        (b"\xff\xfe\xff", "not text in UTF-8"),
        (b"a: \x00", "it cannot be read"),
        (b"[" * 10_000, "it has 10,000 opening brackets"),
        (b"[" * 2000, "it cannot be read"),
        (b"a: !!int many", "not the config.yml of a run"),
    ],
)
def test_other_files_are_one_line(contents: bytes, problem: str, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_bytes(contents)
    with pytest.raises(DataError, match=problem):
        require_known_names(tmp_path / "config.yml")


def test_values_of_a_wrong_kind_are_one_line(tmp_path: Path) -> None:
    run = train_small_model(tmp_path, "run", 2).base_dir
    (checkpoint,) = run.glob("nerfstudio_models/*")
    for old, new, problem in (
        ("near_plane: 0.05", "near_plane: close", "the run cannot be opened"),
        ("near_plane: 0.05", "near_plane: .nan", "near_plane nan"),
        ("log2_hashmap_size: 10", "log2_hashmap_size: 60", "the run cannot be opened"),
        ("eval_num_rays_per_chunk: 8192", "eval_num_rays_per_chunk: 0", "eval_num_rays_per_chunk 0"),
        ("method_name: aenerf", "method_name: !!int many", "the run cannot be opened"),
    ):
        text = (run / "config.yml").read_text()
        assert old in text
        (run / "config.yml").write_text(text.replace(old, new, 1))
        with pytest.raises(DataError, match=problem) as refused:
            open_run(run)
        if problem == "the run cannot be opened":
            error = refused.value.__cause__
            assert f"({type(error).__name__}: " in str(refused.value)
            assert str(refused.value).endswith("ns-eval --load-config shows the traceback")
        (run / "config.yml").write_text(text)
    entries = torch.load(checkpoint, weights_only=False)
    for change, problem in (
        ({"pipeline": {}}, "the run cannot be opened"),
        ({"pipeline": {**entries["pipeline"], "_model.field.aabb": torch.zeros(7)}}, "the run cannot be opened"),
        ({"pipeline": {key: not_finite(key, value) for key, value in entries["pipeline"].items()}}, "is not finite"),
    ):
        torch.save({**entries, **change}, checkpoint)
        with pytest.raises(DataError, match=problem) as refused:
            open_run(run)
    shutil.rmtree(checkpoint.parent)
    with pytest.raises(DataError, match="nerfstudio_models: there is no such folder; copy it from the run"):
        open_run(run)


def test_a_run_opens_wherever_it_and_its_data_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = train_small_model(Path(), "run", 2).base_dir.absolute()
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    assert not config.output_dir.is_absolute()
    data = Path(config.pipeline.datamanager.dataparser.data)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    renamed = run.rename(tmp_path / "elsewhere" / "renamed")
    assert open_run(Path("renamed"))[2].parent == renamed / "nerfstudio_models"
    # A command of Nerfstudio names the file, and tells the configuration nothing.
    monkeypatch.setattr("sys.argv", ["/bin/ns-eval", "--load-config", "renamed/config.yml"])
    assert config.get_checkpoint_dir() == renamed / "nerfstudio_models"
    moved = data.rename(tmp_path / "moved")
    with pytest.raises(DataError, match="the dataset of the run is not there; say where it is now with --data"):
        open_run(renamed)
    output = tmp_path / "poses.txt"
    words = ["aenerf", "export-trajectory", str(renamed), "--output", str(output), "--data", str(moved)]
    monkeypatch.setattr("sys.argv", words)
    main()
    assert output.exists()
    other = shutil.copytree(renamed, tmp_path / "other")
    text = (other / "config.yml").read_text()
    (other / "config.yml").write_text(text.replace(f"- {data.name}\n", "- another\n"))
    with pytest.raises(DataError, match="--data names one dataset, but the runs were trained on several"):
        ReportCommand((renamed, other), tmp_path / "report", data=moved).main()
    # Files beside an event file that stands for a recording move with it.
    before, now = tmp_path / "before", tmp_path / "now"
    now.mkdir()
    (now / "new.h5").touch()
    recording = OwnRecordingDataParserConfig(data=before / "my.h5", events=before / "my.h5", poses=before / "odo.txt")
    config.pipeline.datamanager.dataparser = recording
    _at_its_place(config, renamed / "config.yml", now / "new.h5")
    assert (recording.data, recording.events, recording.poses) == (now / "new.h5", now / "new.h5", now / "odo.txt")


def not_finite(key: str, value: object) -> object:
    is_network = ".field." in key and isinstance(value, torch.Tensor) and value.is_floating_point()
    return value * torch.nan if is_network and not key.endswith("aabb") else value
