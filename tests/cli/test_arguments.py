"""The arguments of ``aenerf``: what a command works on is given as a word, or with its option."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import run as run_command

from aenerf_ns.cli import first_look
from aenerf_ns.cli.arguments import Automatic
from aenerf_ns.cli.check import Check
from aenerf_ns.cli.convert import Convert
from aenerf_ns.cli.evaluate import Evaluate
from aenerf_ns.cli.export_trajectory import ExportTrajectory
from aenerf_ns.cli.main import main
from aenerf_ns.cli.reconstruct import Reconstruct
from aenerf_ns.cli.report import Report
from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.dataparsers.formats import FORMATS

# Of which a message shows all, and no file system has a name.
LONG = "a" * 290

Command = Check | Convert | Evaluate | ExportTrajectory | Reconstruct | Report


# Answers each line with a copy of itself, because a start of Python and the imports of the arguments take a second.
SERVER = """
import io, json, os, sys
from contextlib import redirect_stderr
from aenerf_ns.cli.main import main
for line in sys.stdin:
    folder, words = json.loads(line)
    reader, writer = os.pipe()
    if os.fork() == 0:
        os.chdir(folder)
        sys.argv, status = ["aenerf", *words], 0
        with redirect_stderr(io.StringIO()) as printed:
            try:
                main()
            except SystemExit as end:
                status = end.code
        slow = [name for name in ("torch", "nerfstudio") if name in sys.modules]
        with open(writer, "w") as file:
            json.dump((status, slow, printed.getvalue()), file)
        os._exit(0)
    os.close(writer)
    with open(reader) as file:
        print(file.read(), flush=True)
    os.wait()
"""
Answer = tuple[int, list[str], str]
"""The status, which slow packages were imported, and what was printed as an error."""


@pytest.fixture(scope="module")
def server() -> Iterator[subprocess.Popen]:
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", SERVER], **pipes) as process:
        yield process
        process.terminate()


@pytest.fixture
def answer(server: subprocess.Popen) -> Callable[[str], Answer]:
    """Run a command line in the folder of the test."""

    def ask(line: str) -> Answer:
        assert server.stdin is not None
        assert server.stdout is not None
        print(json.dumps([os.getcwd(), line.split()]), file=server.stdin, flush=True)
        status, slow, error = json.loads(server.stdout.readline())
        return status, slow, error

    return ask


@pytest.fixture(autouse=True)
def what_commands_work_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths that the command lines name, because commands look for them first."""
    monkeypatch.chdir(tmp_path)
    for name in ("F", "G", "ecd-data"):
        (tmp_path / name).mkdir()
        for file in ("events.txt", "calib.txt"):
            (tmp_path / name / file).touch()
        (tmp_path / name / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")
    (tmp_path / "C").write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig {}")
    (tmp_path / "W").touch()


def parsed(line: str, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Return the command made of the words after ``aenerf``, without running it."""
    made: list[Command] = []
    for kind in (Check, Convert, Evaluate, ExportTrajectory, Reconstruct, Report):
        monkeypatch.setattr(kind, "main", lambda command: made.append(command))
    monkeypatch.setattr(sys, "argv", ["aenerf", *line.split()])
    main()
    (command,) = made
    return command


@pytest.mark.parametrize(
    "line",
    [
        "check --data F --picture P.png",
        "check --data=F --picture P.png",
        "check --picture P.png --data F",
        "check --data F --picture P.png auto",
        "check F --picture P.png",
        "check --picture P.png F",
    ],
)
def test_a_dataset_is_checked(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command = parsed(line, monkeypatch)
    assert isinstance(command, Check)
    assert (command.data, command.picture) == (Path("F"), Path("P.png"))
    assert isinstance(command.format, Automatic)


@pytest.mark.parametrize(
    "line",
    [
        "check --data F ecd-data --refractory-period-ns 7",
        "check --data F ecd-data --refractory_period_ns 7",
        "check --data=F ecd-data --refractory-period-ns=7",
        "check F ecd-data --refractory-period-ns 7",
        "check ecd-data F --refractory-period-ns 7",
        "check ecd-data --refractory-period-ns 7 F",
        "check ecd-data --data F --refractory-period-ns 7",
        "check ecd-data --refractory-period-ns 7 --data F",
        # A folder by the name of a format.
        "check --data ecd-data ecd-data --refractory-period-ns 7",
        "check ./ecd-data ecd-data --refractory-period-ns 7",
    ],
)
def test_a_format_and_its_options_follow_or_precede_the_dataset(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command = parsed(line, monkeypatch)
    assert isinstance(command, Check)
    assert command.data == Path("ecd-data" if "ecd-data ecd-data" in line else "F")
    assert isinstance(command.format, EcdDataParserConfig)
    assert command.format.refractory_period_ns == 7


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_takes_the_dataset_as_a_word(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for line in (f"check F {name}", f"check --data F {name}", f"check {name} --data F"):
        command = parsed(line, monkeypatch)
        assert isinstance(command, Check)
        assert command.data == Path("F")
        assert isinstance(command.format, type(FORMATS[name]))


@pytest.mark.parametrize(
    "line",
    [
        "convert --data F --output O --region 1 2 3 4 ecd-data --refractory-period-ns 7",
        "convert --output O --region 1 2 3 4 --data F ecd-data --refractory-period-ns 7",
        "convert F --output O --region 1 2 3 4 ecd-data --refractory-period-ns 7",
        "convert --output O --region 1 2 3 4 F ecd-data --refractory-period-ns 7",
        "convert --output O --region 1 2 3 4 ecd-data --refractory-period-ns 7 --data F",
    ],
)
def test_a_dataset_is_converted(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command = parsed(line, monkeypatch)
    assert isinstance(command, Convert)
    assert (command.data, command.output, command.region) == (Path("F"), Path("O"), (1, 2, 3, 4))
    assert isinstance(command.format, EcdDataParserConfig)
    assert command.format.refractory_period_ns == 7


@pytest.mark.parametrize(
    "line",
    [
        "reconstruct --data F --output O --method e2vid --weights W ecd-data --refractory-period-ns 7",
        "reconstruct F --method e2vid --weights W --output O ecd-data --refractory-period-ns 7",
    ],
)
def test_images_of_a_dataset_are_reconstructed(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command = parsed(line, monkeypatch)
    assert isinstance(command, Reconstruct)
    assert (command.data, command.output) == (Path("F"), Path("O"))
    assert (command.method, command.weights) == ("e2vid", Path("W"))
    assert isinstance(command.format, EcdDataParserConfig)
    assert command.format.refractory_period_ns == 7


def test_an_option_after_the_name_of_a_format_is_that_of_the_format(monkeypatch: pytest.MonkeyPatch) -> None:
    command = parsed("convert F --output O event-recording-data --poses poses.txt", monkeypatch)
    assert isinstance(command, Convert)
    assert command.poses == "given"
    assert str(getattr(command.format, "poses", None)) == "poses.txt"


@pytest.mark.parametrize("name", ["evaluate", "export-trajectory"])
@pytest.mark.parametrize("run", ["--load-config C", "--load_config C", "--load-config=C", "C"])
def test_a_run_is_given(name: str, run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for line in (f"{name} {run} --output O", f"{name} --output O {run}"):
        command = parsed(line, monkeypatch)
        assert isinstance(command, Evaluate | ExportTrajectory)
        assert (command.load_config, command.output) == (Path("C"), Path("O"))


def test_runs_to_report_on_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    for line in ("report C F/../C --output O", "report --output O C F/../C"):
        command = parsed(line, monkeypatch)
        assert isinstance(command, Report)
        assert (command.runs, command.output) == ((Path("C"), Path("F/../C")), Path("O"))


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("check F --data G", "Error: F: --data G is given as well; leave out one of the two"),
        ("check --data G --picture P.png F", "Error: F: --data G is given as well; leave out one of the two"),
        ("check F ecd-data --data G", "Error: F: --data G is given as well; leave out one of the two"),
        ("convert F --data G --output O", "Error: F: --data G is given as well; leave out one of the two"),
        ("evaluate F --load-config G --output O", "Error: F: --load-config G is given as well; leave out one"),
        ("export-trajectory F --load-config G --output O", "Error: F: --load-config G is given as well; leave out one"),
        ("check", "Error: aenerf: nothing to work on is given; name it after the command, or with --data"),
        ("check ecd-data", "Error: aenerf: nothing to work on is given; name it after the command, or with --data"),
        ("evaluate --output O", "nothing to work on is given; name it after the command, or with --load-config"),
    ],
)
def test_what_a_command_works_on_is_given_once(
    line: str, complaint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as end:
        parsed(line, monkeypatch)
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "unknown"), [("check F G", "G"), ("check F --pictures P", "--pictures"), ("convert F O", "--output")]
)
def test_other_words_are_refused(
    line: str, unknown: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as end:
        parsed(line, monkeypatch)
    assert end.value.code == 2
    assert unknown in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "word", "option"),
    [
        ("check", "DATA", "--data DATA"),
        ("convert", "DATA", "--data DATA"),
        ("reconstruct", "DATA", "--data DATA"),
        ("evaluate", "RUN", "--load-config RUN"),
        ("export-trajectory", "RUN", "--load-config RUN"),
        ("export-cameras", "RUN", "--load-config RUN"),
    ],
)
def test_the_help_names_both_ways(
    name: str, word: str, option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as end:
        parsed(f"{name} --help", monkeypatch)
    assert end.value.code == 0
    # Without the frames and the line breaks of the help.
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    positional, options = printed.split("positional arguments")[1].split(" options", 1)
    assert word in positional
    assert f"(required, here or with {option.split()[0]})" in positional
    assert option in options


def test_the_real_command_takes_a_word(tmp_path: Path) -> None:
    printed = run_command("aenerf", "check", tmp_path / "nothing", cwd=tmp_path, fails=True)
    assert printed.strip().splitlines()[-1].startswith(f"Error: {tmp_path / 'nothing'}: there is no such folder")


@pytest.mark.parametrize(
    ("line", "status", "complaint"),
    [
        ("check nothing", 2, "nothing: there is no such folder"),
        ("check --picture P.png --data=nothing ecd-data", 2, "nothing: there is no such folder"),
        ("convert nothing --output O", 1, "nothing: there is no such folder"),
        ("convert F --output G", 1, "G: the folder exists already"),
        ("simulate --scene room --output G", 1, "G: the folder exists already"),
        ("evaluate nothing.yml --output O", 1, "nothing.yml: there is no such file"),
        ("export-trajectory --load_config nothing.yml --output O", 1, "nothing.yml: there is no such file"),
        ("export-cameras nothing --output O", 1, "nothing: there is no such file"),
        ("export-frames F --output G", 1, "G: the folder exists already"),
        ("report C nothing --output O", 1, "nothing: there is no such file"),
        (f"simulate --output {LONG}", 1, f"{LONG}: it cannot be created (File name too long); choose another --output"),
        (f"evaluate {LONG} --output O", 1, f"{LONG}: it cannot be read (File name too long); check its name"),
        ("check F --picture F", 2, "F: its name is not that of a picture; end the --picture with .png"),
        ("check F --picture C/a.png", 2, "C/a.png: it cannot be created (Not a directory); choose another --picture"),
        ("convert F --output O --pixel-share 2", 1, "aenerf convert: the share of pixels must be above 0"),
        ("convert F --output O --pixel-share 2 ecd-data", 1, "aenerf convert: the share of pixels must be above 0"),
        ("convert F --output O --seed -1", 1, "aenerf convert: --seed -1; give a whole number from 0 on"),
        ("reconstruct F --output O --method e2vid", 1, "--method e2vid: no weights are given; download"),
        ("reconstruct F --output O --events-per-pixel nan", 1, "aenerf reconstruct: nan events a pixel"),
        ("reconstruct F --output O --events-per-pixel 1e300", 1, "aenerf reconstruct: 1e+300 events a pixel; give an"),
        ("export-frames C --output O --rate nan", 1, "aenerf export-frames: a rate of nan; give one above 0"),
        ("export-video C --output O.mp4 --rate 0", 1, "aenerf export-video: a rate of 0.0; give one above 0"),
        ("export-video C --output O.mp4 --frame-rate 0", 1, "aenerf export-video: a frame rate of 0.0; give one from"),
        ("export-video C --output O.gif", 1, "O.gif: only videos of the kind .mp4 are written; end the --output with"),
        ("evaluate C --output O --render-output W", 1, "W/0000.png: it cannot be created (Not a directory); choose"),
        (
            "export-cameras C --output O --num-points 1000000000000",
            1,
            "aenerf export-cameras: 1e+12 points; give from 1",
        ),
        (
            "export-mesh C --output O.ply --num-views 1000000",
            1,
            "aenerf export-mesh: 1e+06 views; give from 1 to",
        ),
        (f"simulate --output O --train-images {10**400}", 1, "aenerf simulate: --train-images 1000000000"),
        ("simulate --output O --scene nothing.glb", 1, "nothing.glb: the file does not exist; check the name"),
        ("simulate --output O --width 0", 1, "aenerf simulate: --width 0; give a number from 1 to 16384"),
        ("simulate --output O --leak-rate -1", 1, "aenerf simulate: --leak-rate -1; give a number from 0 to 1e+06"),
        ("simulate --output O --leak-rate 1e300", 1, "aenerf simulate: --leak-rate 1e+300; give a number from 0"),
        ("simulate --output O --duration 1e-300", 1, "aenerf simulate: --duration 1e-300; give a number from 0.001"),
        (
            "simulate --output O --duration 10000 --pose-rate 1e5",
            1,
            "aenerf simulate: 1e+09 poses; give a lower --pose",
        ),
        (
            "simulate --output O --duration 0.05 --pose-rate 10",
            1,
            "aenerf simulate: --pose-rate 10 gives one pose; give a higher --pose-rate",
        ),
        ("simulate --output O --train-images 1000000000000", 1, "aenerf simulate: --train-images 1e+12; give a number"),
        ("simulate --output O --width 9999 --height 9999", 1, "aenerf simulate: an event sensor of 9999 x 9999 pixels"),
        (
            "convert F --output O --shortest-interval-ns 10000000000000000000",
            1,
            "aenerf convert: the shortest interval",
        ),
        ("simulate --output O --positive-contrast-threshold 0", 1, "aenerf simulate: positive_contrast_threshold must"),
        (
            "simulate --output O --interpolation linear",
            1,
            "aenerf simulate: --interpolation has no meaning for",
        ),
        ("simulate --output O --video F --trajectory W", 1, "aenerf simulate: --trajectory without the intrinsics"),
        ("evaluate W --output O", 1, "W: it is no configuration of a run; give the config.yml of a trained run"),
        ("evaluate C --output F", 1, "F: it cannot be created (Is a directory); choose another --output"),
        ("export-trajectory C --output O --rate 0", 1, "aenerf export-trajectory: a rate of 0.0; give one above 0"),
    ],
)
def test_mistakes_are_named_before_slow_imports(
    line: str, status: int, complaint: str, answer: Callable[[str], Answer], tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    broken = tmp_path / "broken"
    shutil.copytree(tmp_path / "F", broken)
    (broken / "groundtruth.txt").write_text("0 0 0\n")
    code, slow, error = answer(line)
    assert (code, slow) == (status, [])
    assert error.startswith(f"Error: {complaint}")
    assert error.count("\n") == 1


@pytest.mark.parametrize("line", ["--help", "check --help", "simulate --help", "evaluate --help", "check --nothing"])
def test_help_and_complaints_take_no_slow_imports(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("the commands were imported")

    monkeypatch.setattr(first_look, "judge", fail)
    with pytest.raises(SystemExit):
        parsed(line, monkeypatch)
    assert capsys.readouterr()
