"""The arguments of ``aenerf``: what they are parsed to, and that mistakes in them are reported at once."""

import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from aenerf_ns.cli import main as main_module
from aenerf_ns.cli.check import Check
from aenerf_ns.cli.dataset import DatasetCommand, training_command
from aenerf_ns.cli.main import COMMANDS, load_command, main
from aenerf_ns.errors import DataError

# Shown whole by a message, and no file system has a name of this length.
LONG = "a" * 290


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with what the command lines name: a dataset F, a run's config.yml C, a text file W and a link
    to nothing L."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "F").mkdir()
    for file in ("events.txt", "calib.txt", "groundtruth.txt"):
        (tmp_path / "F" / file).touch()
    (tmp_path / "C").write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig {}")
    (tmp_path / "W").touch()
    (tmp_path / "L").symlink_to("nothing")
    return tmp_path


def parse(line: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make the command of the words after ``aenerf``, without running it."""
    made: list[Any] = []
    monkeypatch.setattr(load_command(line.split()[0]), "main", lambda command: made.append(command))
    monkeypatch.setattr(sys, "argv", ["aenerf", *line.split()])
    main()
    (command,) = made
    return command


@pytest.mark.parametrize("data", ["F", "--data F", "--data=F"])
@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("check {} --picture P.png", {"picture": Path("P.png"), "format": "auto"}),
        ("check --picture P.png {}", {"picture": Path("P.png")}),
        ("check {} --format ecd-data", {"format": "ecd-data"}),
        ("check {} --format-options width=3 height=4", {"format_options": ("width=3", "height=4")}),
        ("convert --output O --region 1 2 3 4 {}", {"output": Path("O"), "region": (1, 2, 3, 4)}),
        ("reconstruct {} --output O --weights W", {"weights": Path("W")}),
    ],
)
def test_dataset_is_positional_or_named(
    data: str, line: str, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = parse(line.format(data), monkeypatch)
    assert {name: getattr(command, name) for name in ("data", *values)} == {"data": Path("F"), **values}


def test_named_dataset_may_follow_format_options(monkeypatch: pytest.MonkeyPatch) -> None:
    command = parse("check --format-options width=3 --data F", monkeypatch)
    assert (command.data, command.format_options) == (Path("F"), ("width=3",))


@pytest.mark.parametrize("name", [name for name in COMMANDS if name.startswith(("evaluate", "export-"))])
@pytest.mark.parametrize("run", ["--load-config C", "--load_config C", "--load-config=C", "C"])
def test_run_is_positional_or_named(name: str, run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for line in (f"{name} {run} --output O", f"{name} --output O {run}"):
        command = parse(line, monkeypatch)
        assert (command.load_config, command.output) == (Path("C"), Path("O"))


def test_report_takes_several_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for line in ("report C F/../C --output O", "report --output O C F/../C"):
        command = parse(line, monkeypatch)
        assert (command.runs, command.output) == ((Path("C"), Path("F/../C")), Path("O"))


@pytest.mark.parametrize("video", ["V", "--video V"])
def test_video_is_positional_or_named(video: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for line in (f"{video} --output O --intrinsics 1 2 3 4", f"--output O --intrinsics 1 2 3 4 {video}"):
        command = parse(f"simulate-video {line}", monkeypatch)
        assert (command.video, command.output, command.intrinsics) == (Path("V"), Path("O"), (1.0, 2.0, 3.0, 4.0))


# The exit status, and a part of what is printed, for mistakes in arguments and for paths that cannot be.
MISTAKES = [
    ("", 2, "Expected one of {simulate,"),
    ("inspect F", 2, "inspect"),
    ("check", 2, "DATA"),
    ("check F --data G", 2, "Unrecognized options: F"),
    ("check F G", 2, "Unrecognized options: G"),
    ("check F --nonsense", 2, "--nonsense"),
    ("check F --format nonsense", 2, "invalid choice 'nonsense'"),
    ("evaluate --output O", 2, "RUN"),
    ("evaluate C D --output O", 2, "Unrecognized options: D"),
    ("simulate --output O --interpolation linear", 2, "--interpolation"),
    ("simulate-video V --output O --speed hard", 2, "--speed"),
    ("check nothing", 2, "Error: nothing: there is no such folder"),
    ("check nothing --format ecd-data", 2, "Error: nothing: there is no such folder"),
    ("check F --picture F", 2, "Error: F: not the name of a picture; end the --picture with .png"),
    ("check F --picture C/a.png", 2, "Error: C/a.png: it cannot be created (Not a directory); choose"),
    ("convert nothing --output O", 1, "Error: nothing: there is no such folder"),
    ("convert F --output F", 1, "Error: F: the folder exists already"),
    ("convert F --output L", 1, "Error: L: the folder exists already"),
    ("convert F --output O --pixel-share 2", 1, "Error: aenerf convert: the share of pixels must be above 0"),
    ("convert F --output O --seed -1", 1, "Error: --seed: -1 is out of range"),
    ("convert F --output O --shortest-interval-ns 10000000000000000000", 1, "Error: aenerf convert: the shortest"),
    ("reconstruct F --output O --weights nothing", 1, "Error: nothing: there is no such file; download firenet_1000"),
    ("convert F --output O --weights W", 1, "Error: --weights: --poses given makes no images of events; choose"),
    ("reconstruct F --output O --events-per-pixel nan", 1, "Error: --events-per-pixel: nan is out of range"),
    ("simulate --output F", 1, "Error: F: the folder exists already"),
    (f"simulate --output {LONG}", 1, f"Error: {LONG}: it cannot be created (File name too long); choose another"),
    ("simulate --output O --scene nothing.glb", 1, "Error: nothing.glb: there is no such file"),
    ("simulate --output O --width 0", 1, "Error: --width: 0 is out of range; give a number from 1 to 16384"),
    ("simulate --output O --width 9999 --height 9999", 1, "Error: aenerf simulate: an event sensor of 9999 x 9999"),
    ("simulate --output O --duration 10000 --pose-rate 1e5", 1, "Error: --pose-rate: it gives 1e+09 poses"),
    ("simulate --output O --duration 4 --speed hard --pose-rate 0.2", 1, "Error: --pose-rate: 0.2 a second gives one"),
    ("simulate --output O --positive-contrast-threshold 0", 1, "Error: --positive-contrast-threshold: 0.0 is out"),
    ("simulate-video V --output O --refractory-period-ns -1", 1, "Error: --refractory-period-ns: -1 is out of range"),
    ("simulate --output O --poses colmap --pose-noise-degrees 1", 1, "COLMAP makes errors of its own"),
    ("simulate-video nothing --output O", 1, "Error: nothing: there is no such video"),
    ("simulate-video F --output O --trajectory W", 1, "--trajectory without the intrinsics of the camera; give"),
    ("simulate-video F --output O --calibration nothing", 1, "Error: nothing: "),
    ("evaluate nothing.yml --output O", 1, "Error: nothing.yml: there is no such file"),
    (f"evaluate {LONG} --output O", 1, f"Error: {LONG}: it cannot be read (File name too long)"),
    ("evaluate W --output O", 1, "Error: W: not the config.yml of a run"),
    ("evaluate C --output F", 1, "Error: F: it cannot be created (Is a directory); choose another --output"),
    ("evaluate C --output /dev/null", 1, "Error: /dev/null: it cannot be created (File exists); choose"),
    ("evaluate C --output O --render-output W", 1, "Error: W/0000.png: it cannot be created (Not a directory)"),
    ("evaluate C --output O --nerfbaselines F", 1, "Error: F: the folder exists already"),
    ("report W nothing --output O", 1, "Error: nothing: there is no such file"),
    ("export-trajectory C --output O --rate 0", 1, "Error: --rate: 0.0 is out of range"),
    ("export-cameras C --output O --num-points 1000000000000", 1, "Error: --num-points: 1000000000000 is out of"),
    ("export-frames C --output F", 1, "Error: F: the folder exists already"),
    ("export-frames C --output O --rate 1 --times 1", 1, "--rate and --times are given"),
    ("export-mesh C --output O.stl", 1, "Error: O.stl: not a mesh file"),
    ("export-mesh C --output O.ply --num-views 1000000", 1, "Error: --num-views: 1000000 is out of range"),
    ("export-mesh C --output O.ply --num-views 1", 1, "Error: --num-views: 1 is out of range; give a number from 2 to"),
    ("export-video C --output O.gif", 1, "Error: O.gif: only videos of the kind .mp4"),
    ("export-video C --output O.mp4 --frame-rate 0", 1, "Error: --frame-rate: 0.0 is out of range"),
]
HELP = [("--help", 0, "Check the events"), *((f"{name} --help", 0, f"usage: aenerf {name}") for name in COMMANDS)]


def test_mistakes_are_reported_before_slow_imports() -> None:
    environment = {**os.environ, "COLUMNS": "200"}
    done = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "no slow imports", done.stderr


def answer_all() -> None:
    """Answer each command line in this process, and show that none of them imports torch."""
    for line, status, part in MISTAKES + HELP:
        sys.argv = ["aenerf", *line.split()]
        with redirect_stderr(io.StringIO()) as error, redirect_stdout(io.StringIO()) as output:
            try:
                main()
                code: object = 0
            except SystemExit as end:
                code = end.code
        printed = output.getvalue() + error.getvalue()
        assert code == status, (line, code, printed)
        assert part in printed, (line, printed)
        assert not printed.startswith("Error: ") or printed.count("\n") == 1, printed
    slow = {"torch", "open3d", "nerfstudio.engine"} & set(sys.modules)
    print(f"imported {slow}" if slow else "no slow imports")


@pytest.mark.parametrize(
    ("options", "values"),
    [
        ((), {}),
        (("refractory_period_ns=7",), {"refractory_period_ns": 7}),
        (("refractory-period-ns=7", "width=20"), {"refractory_period_ns": 7, "width": 20}),
        (("trajectory=/other=1.txt",), {"trajectory": Path("/other=1.txt")}),
        (("max_pose_gap_ns=None", "positive-contrast-threshold=0.5"), {"positive_contrast_threshold": 0.5}),
    ],
)
@pytest.mark.parametrize("name", ["auto", "ecd-data"])
def test_format_takes_options(name: str, options: tuple[str, ...], values: dict[str, Any], folder: Path) -> None:
    from aenerf_ns.dataparsers.ecd import EcdDataParserConfig

    parser = DatasetCommand(folder / "F", format=name, format_options=options).open_dataset()
    expected = EcdDataParserConfig(data=folder / "F", **values)
    assert parser.config == expected
    assert parser.guessed_format == ("ecd-data" if name == "auto" else None)


def test_every_command_drops_malformed_events(folder: Path) -> None:
    assert DatasetCommand(folder / "F", drop_malformed=True).open_dataset().config.drop_malformed


@pytest.mark.parametrize(
    ("option", "part"),
    [
        ("nonsense=1", "not an option of ecd-data; write KEY=VALUE with one of max_pose_gap_ns, drop_malformed"),
        ("F", "not an option of ecd-data; write KEY=VALUE"),
        # Commands keep the world of the recording.
        ("scale_factor=2", "not an option of ecd-data"),
        ("data=other", "not an option of ecd-data"),
        ("width=wide", "'wide' is not a value of width"),
    ],
)
def test_wrong_option_of_a_format_is_one_line(option: str, part: str, folder: Path) -> None:
    with pytest.raises(DataError, match=part) as error:
        DatasetCommand(folder / "F", format_options=(option,)).open_dataset()
    assert error.value.source == f"--format-options {option}"


def test_a_check_takes_options_that_place_the_scene(folder: Path) -> None:
    parser = Check(folder / "F", format_options=("scale-factor=2", "end-time-ns=5")).open_dataset()
    assert (parser.config.scale_factor, parser.config.end_time_ns) == (2.0, 5)


def test_training_command_is_quoted() -> None:
    planes = {"pipeline.model.near-plane": "0.3", "pipeline.model.far-plane": "20"}
    assert training_command(Path("my data"), options=planes, format_words=["ecd-data", "--width", "346"]) == (
        "ns-train aenerf --pipeline.model.near-plane 0.3 --pipeline.model.far-plane 20 --data 'my data' "
        "ecd-data --width 346"
    )
    assert training_command(Path("data"), "e2vid-nerf") == "ns-train e2vid-nerf --data data"


@pytest.mark.slow
def test_exporter_of_nerfstudio_starts_without_libusb() -> None:
    """Where the system has libusb, this shows only that the exporter takes its arguments."""
    command = [sys.executable, "-m", "aenerf_ns.cli.ns_export", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "{pointcloud," in done.stdout
    # The name by which a run's configuration knows that the run is opened.
    assert done.stdout.startswith("usage: ns-export ")


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def interrupted_in_a_library(*_: object) -> None:
    try:
        interrupted()
    except KeyboardInterrupt as error:
        raise ImportError("the library cannot be imported") from error


@pytest.mark.parametrize("place", [(Check, "main"), (main_module, "load_command")], ids=["command", "import"])
@pytest.mark.parametrize("interrupt", [interrupted, interrupted_in_a_library])
def test_an_interrupt_is_one_line(
    interrupt: Callable, place: tuple[object, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(*place, interrupt)
    monkeypatch.setattr("sys.argv", ["aenerf", "check", "somewhere"])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 130
    assert capsys.readouterr().err == "Stopped.\n"


def test_a_terminal_without_utf_8_shows_question_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Check, "main", lambda _: print("\u2588"))
    monkeypatch.setattr(sys, "argv", ["aenerf", "check", "F"])
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written := io.BytesIO(), "ascii"))
    main()
    sys.stdout.flush()
    assert written.getvalue() == b"?\n"


if __name__ == "__main__":
    answer_all()
