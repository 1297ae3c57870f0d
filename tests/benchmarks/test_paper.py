"""The paper's tables: the plan, the tables against hand-made figures, and a whole small benchmark by the command."""

import json
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest
import torch
import torchmetrics.functional as functional
import torchmetrics.image.lpip as lpip
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.nerfacto import NerfactoModelConfig
from PIL import Image

from aenerf_ns.cli.ranges import require_seed
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.method.image_metrics import ImageMetrics
from aenerf_ns.method_configs.aenerf import aenerf_small
from aenerf_ns.method_configs.aenerf_mlp import aenerf_mlp, aenerf_mlp_small
from benchmarks.paper import tables
from benchmarks.paper.__main__ import _make as make_all
from benchmarks.paper.figures import draw, error_map
from benchmarks.paper.plan import (
    CEILING,
    CORRECTED,
    FILTERED,
    LOSSES,
    ON_TRUE_POSES,
    OURS,
    POSES_OF_EVENTS,
    TRUE_POSES,
    WITHOUT_CORRECTION,
    Plan,
    Run,
)
from benchmarks.paper.running import Runner
from benchmarks.paper.worker import prepare

ROOT = Path(__file__).parents[2]


def small_plan(**changes: Any) -> list[Run]:
    options: dict[str, Any] = {
        "scenes": ("room", "object"),
        "speeds": ("easy", "hard"),
        "poses": "noise",
        "tables": ("methods", "losses"),
        "seeds": (1, 2),
        "scale": "tiny",
    }
    return Plan(**{**options, **changes}).runs()


def test_plan_has_every_run_once() -> None:
    runs = small_plan()
    assert len({run.name for run in runs}) == len(runs) == 2 * (2 * 2 * 4 + 2 * 4)
    rows = Counter(run.row for run in runs)
    assert rows == {OURS: 8, WITHOUT_CORRECTION: 8, TRUE_POSES: 8, CEILING: 8, **dict.fromkeys(LOSSES, 4)}
    # The bounds are of true poses, all else of estimated ones; the paper's ablation of losses is of hard speed.
    for run in runs:
        assert run.true_poses == (run.row in (TRUE_POSES, CEILING))
        assert run.table == "methods" or run.dataset.speed == "hard"
    # One simulation serves all rows, each with a seed of its own.
    datasets = {run.dataset for run in runs}
    assert len({data.options[data.options.index("--seed") + 1] for data in datasets}) == len(datasets) == 2 * 2
    colmap = ("--poses", "colmap", "--frame-rate", "250")
    assert all(run.dataset.options[-4:] == colmap for run in small_plan(poses="colmap"))


def test_medium_scale_has_poses_of_events_too() -> None:
    runs = small_plan(scale="medium", tables=("methods",), seeds=(1,), scenes=("room",), speeds=("hard",))
    assert {run.row: run.convert for run in runs if run.convert} == POSES_OF_EVENTS
    assert {run.method for run in runs} == {"aenerf-small", "nerfacto"}
    assert {run.dataset for run in runs} == {
        run.dataset
        for run in small_plan(scale="full", tables=("methods",), seeds=(1,), scenes=("room",), speeds=("hard",))
    }
    assert len({run.name for run in runs}) == 6


def test_weights_choose_e2vid(tmp_path: Path) -> None:
    options: dict[str, Any] = {"methods": ("e2vid-nerf",), "tables": ("methods",)}
    with_weights = small_plan(e2vid_weights=tmp_path / "e2vid.pth.tar", **options)
    assert {run.row for run in with_weights} == {"E2VID + NeRF" + end for end in ("", CORRECTED, ON_TRUE_POSES)}
    assert with_weights[0].images == ("--weights", str(tmp_path / "e2vid.pth.tar"))
    assert not {run.name for run in with_weights} & {run.name for run in small_plan(**options)}


def test_losses_are_compared_on_equal_pairs() -> None:
    option = "--pipeline.datamanager.train-num-rays-per-batch"
    for scale, method in (("tiny", aenerf_mlp_small), ("full", aenerf_mlp)):
        own = method.config.pipeline.datamanager.train_num_rays_per_batch
        runs = small_plan(scale=scale, tables=("losses",), seeds=(1,), scenes=("room",))
        assert {run.method for run in runs} == {method.config.method_name}
        rays = {run.row: int(run.options[run.options.index(option) + 1]) for run in runs}
        assert rays["l_p + l_r"] == rays["l_p + l_r + l_d"] == own
        assert rays["l_p + l_r + l_g"] == rays["all"] == own // 2 * 3


def test_seeds_of_the_datasets_are_accepted() -> None:
    scenes = [f"scenes/{name}/scene.json" for name in ("games", "forklift", "living_room", "workshop")]
    seeds = [
        int(run.dataset.options[run.dataset.options.index("--seed") + 1])
        for run in small_plan(scenes=scenes, seeds=(1,))
    ]
    assert max(seeds) >= 2**31
    for seed in seeds:
        require_seed(seed)


def test_name_tells_runs_apart() -> None:
    names = {run.name for run in small_plan()}
    for change in (
        {"steps": 7},
        {"seeds": (3,)},
        {"scale": "full"},
        {"train": "--pipeline.model.field.num-levels 4"},
        {"simulate": "--refractory-period-ns 1000"},
    ):
        changed = {run.name for run in small_plan(**change) if run.row != CEILING}
        assert not changed & names, change


@pytest.mark.parametrize(
    ("folder", "options"),
    [
        ("tiny", {"methods": ("aenerf",), "seeds": (42, 43, 44)}),
        (
            "tiny_methods",
            {"methods": ("aenerf", "robust-enerf", "eventnerf", "evnerf", "paev3d"), "seeds": (42,), "steps": 400},
        ),
        ("tiny_methods_seed43", {"methods": ("aenerf", "eventnerf", "evnerf"), "seeds": (43,), "steps": 400}),
    ],
)
def test_published_runs_and_tables_are_made_again(folder: str, options: dict[str, Any]) -> None:
    published = ROOT / "benchmarks" / "results" / folder
    names = ("forklift", "gallery", "games", "living_room", "lounge", "workshop")
    scenes = [f"scenes/{name}/scene.json" for name in names]
    runs = small_plan(scenes=scenes, tables=("methods",), **options)
    num_runs = 6 * 2 * 3 * len(options["methods"]) * len(options["seeds"])
    assert len({run.name for run in runs}) == len(runs) == num_runs
    # Registered under these names, and corrected by the same spline as ours.
    assert all_methods.keys() >= {run.method for run in runs}
    assert aenerf_small.config.pipeline.model.camera_optimizer.mode == "spline"
    figures = [json.loads((published / f"{run.name}.json").read_text()) for run in runs]
    for run, one in zip(runs, figures, strict=True):
        assert (run.row, run.method, run.true_poses) == (one["row"], one["method"], one["poses"] == "true")
    made, kept = tables.report(figures, {}).splitlines(), (published / "report.md").read_text().splitlines()
    assert {line for line in made if line.startswith("| ")} <= {*kept}


def test_a_run_that_renders_no_numbers_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Nerfstudio trains on when the weights of nerfacto are lost.
    run = next(run for run in small_plan() if run.row == CEILING)
    (tmp_path / "transforms.json").write_text("{}")

    def train(*_: Any) -> tuple[str, ...]:
        for file in (tmp_path / "outputs" / run.name / "config.yml", tmp_path / "runs" / run.name / "evaluation.json"):
            file.parent.mkdir()
            file.write_text('{"results": {"psnr": NaN}, "train_seconds": 1.0}')
        return ()

    monkeypatch.setattr(Runner, "_dataset", lambda *_: tmp_path)
    monkeypatch.setattr(Runner, "_train", train)
    runner = Runner(tmp_path, "cpu")
    assert "pictures are NaN" in make_all(runner, [run])[run.name]
    assert runner.figures(run) is None


def test_scene_file_has_the_name_of_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run, *_) = small_plan(scenes=("scenes/piano/scene.json",))
    assert run.name.startswith("piano_easy_")
    (run, *_) = small_plan(scenes=("models/lamp.glb",))
    assert run.name.startswith("lamp_easy_")
    (tmp_path / "hall").mkdir()
    monkeypatch.chdir(tmp_path / "hall")
    (run, *_) = small_plan(scenes=("scene.json",))
    assert run.name.startswith("hall_easy_")
    with pytest.raises(DataError, match="two scenes have the name piano"):
        small_plan(scenes=("old/piano/scene.json", "new/piano/scene.json"))


def figures_of(run: Run, psnr: float, kind: str, errors: tuple[float, float]) -> dict[str, Any]:
    poses = {
        which: {"rotation_error_degrees": error, "translation_error_percent": 2 * error}
        for which, error in zip(("estimated", "corrected"), errors, strict=True)
    }
    return {
        "table": run.table,
        "row": run.row,
        "scene": run.dataset.scene,
        "kind": kind,
        "speed": run.dataset.speed,
        "method": run.method,
        "steps": run.steps,
        "seed": run.seed,
        "device": "cpu",
        "simulate": " ".join(("aenerf", "simulate", *run.dataset.command)),
        "poses_report": None,
        "results": {"psnr": psnr, "ssim": psnr / 100, "lpips": None, "pose_errors": poses},
        "machine": {"cpu": "a processor", "gpu": "of no use here", "cores": 2},
        "versions": {"aenerf-ns": "0.1.0"},
        "commit": "abc",
    }


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def test_report_of_incomplete_runs() -> None:
    runs = small_plan()
    figures = [figures_of(run, 20 + index, "large", (3.0, 1.0)) for index, run in enumerate(runs)]
    losses = [one for one in figures if one["table"] == "losses"]
    for one in losses:
        one["results"]["refined_test_poses"] = {"psnr": 21.0 + one["seed"], "ssim": 0.25, "lpips": None}
    rows = cells(tables.losses_table(losses))[2:]
    assert [row[0] for row in rows] == list(LOSSES)
    # LPIPS is not known, and never a number then.
    assert rows[0][2:] == [f"{fmean(one['results']['ssim'] for one in losses[::4]):.3f} / 0.250", "n/a / -"]
    # A mean of fewer runs would not stand beside the other one.
    del losses[0]["results"]["refined_test_poses"]
    assert cells(tables.losses_table(losses))[2][1].endswith(" / -")
    text = tables.report(figures[:-1], {"the last": "out of memory", "another": ""})
    assert f"2 of {len(figures) + 1} runs are missing" in text
    assert "- the last: out of memory\n- another\n" in text
    assert "- a processor, 2 cores; aenerf-ns 0.1.0; commit abc" in text
    assert "- aenerf-small, 1500 steps\n- nerfacto, 1500 steps\n" in text
    assert text.count("- data: `aenerf simulate --scene SCENE --speed SPEED --width 96 --height 72 ") == 1


def test_report_orders_methods() -> None:
    methods = ("aenerf", "e2vid-nerf", "paev3d", "nerfacto")
    runs = small_plan(methods=methods, tables=("methods",), seeds=(1,), speeds=("hard",), scenes=("object",))
    # The rows are worse, the later they are made.
    psnr = {run.row: 30.0 - index for index, run in enumerate(runs)}
    figures = [
        {**figures_of(run, psnr[run.row], "object", (1.0, 0.5)), "reconstruct": " ".join(run.images)} for run in runs
    ]
    text = tables.report(figures, {})
    paper = "E2VID + NeRF (18.92) < EventNeRF (24.92) < Ev-NeRF (25.44) < Robust e-NeRF (28.37) < AE-NeRF (28.90)"
    assert f"- the paper: {paper}\n" in text
    own = {"which only AE-NeRF corrects": (OURS, ""), "which all correct": (OURS, CORRECTED)}
    for setting, (row, end) in own.items():
        means = {"PAEv3D": psnr["PAEv3D" + end], FILTERED: psnr[FILTERED + end], "AE-NeRF": psnr[row]}
        order = " < ".join(f"{name} ({mean:.2f})" for name, mean in means.items())
        assert f"- here, estimated poses, {setting}: {order}\n" in text
    assert "- images of the events: `aenerf reconstruct --events-per-pixel 0.35`\n" in text
    # The paper's color correction stands beside, where it was measured.
    assert f"| PAEv3D | - | {psnr['PAEv3D']:.2f} / - |" in text
    for one in figures:
        one["results"]["psnr_network"] = one["results"]["psnr"] + 0.25
    assert f"| PAEv3D | - | {psnr['PAEv3D']:.2f} / - / {psnr['PAEv3D'] + 0.25:.2f} |" in tables.report(figures, {})
    # One method alone has no order.
    uncorrected = [one for one in figures if not one["row"].endswith(CORRECTED)]
    assert "which all correct" not in tables.report(uncorrected, {})
    # Without AE-NeRF there are no errors of poses to report, and without other methods no order.
    alone = tables.report([one for one in figures if one["method"] == "paev3d-small"], {})
    assert "table 3" not in alone
    assert "Order by PSNR" in alone
    own_rows = tables.report([one for one in figures if one["method"] in ("aenerf-small", "nerfacto")], {})
    assert "Order by PSNR" not in own_rows


def test_means_are_over_common_runs() -> None:
    runs = [run for run in small_plan(speeds=("hard",), seeds=(1,)) if run.row != CEILING]
    worth = {"room": 20.0, "object": 30.0}
    figures = [figures_of(run, worth[run.dataset.scene], "large", (1.0, 0.5)) for run in runs]
    for table, make in (("methods", tables.methods_table), ("losses", tables.losses_table)):
        of_table = [one for one in figures if one["table"] == table]
        _, _, *rows = cells(make(of_table))
        assert {row[1] for row in rows} == {"25.00 / -"}
        # More seeds of one scene do not make it count more.
        more = [{**one, "seed": 2} for one in of_table if one["scene"] == "room"]
        assert make([*of_table, *more]) == make(of_table)
        # The first row lacks the easy scene, and would look worse than it is.
        partial = [one for one in of_table if one["row"] not in (OURS, "all") or one["scene"] == "room"]
        _, _, *rows = cells(make(partial))
        assert {row[1] for row in rows} == {"20.00 / -"}


def test_rows_of_few_scenes_leave_the_means_of_the_others() -> None:
    plan = small_plan(scale="medium", tables=("methods",), methods=("aenerf",), speeds=("hard",), seeds=(1,))
    worth = {"room": 20.0, "object": 30.0}
    figures = [figures_of(run, worth[run.dataset.scene], "large", (1.0, 0.5)) for run in plan]
    text = tables.report([one for one in figures if one["row"] not in POSES_OF_EVENTS or one["scene"] == "room"], {})
    all_scenes, few = text.split("## Poses that the events refine or find")
    assert all_scenes.count("| 25.00 / - |") == 3
    assert few.split("\n## ")[0].count("| 20.00 / - |") == 5
    assert "events refine" not in tables.report([one for one in figures if one["row"] not in POSES_OF_EVENTS], {})


def test_report_lists_colmap_sequences() -> None:
    run, other = small_plan(poses="colmap", tables=("losses",), seeds=(1,))[:2]
    errors = {"rotation_error_degrees": 0.5, "translation_error": 0.04, "misplaced_frames": 2}
    poses = {"frames": 33, "registered_frames": 30, "errors": errors}
    poses["errors_between_frames"] = {"rotation_error_degrees": 3.0, "translation_error": 0.25}
    figures = [{**figures_of(one, 20.0, "large", (1.0, 0.5)), "poses_report": poses} for one in (run, other)]
    # Poses that are found by the events have another report.
    figures.append({**figures[0], "convert": "aenerf convert --poses refined", "poses_report": {"tracks": 9}})
    text = tables.report(figures, {})
    assert text.count("| room | hard | 33 | 30 | 2 | 0.50° | 4.0 cm | 3.00° | 25.0 cm |") == 1


def test_nerfacto_has_the_same_ssim(monkeypatch: pytest.MonkeyPatch) -> None:
    # As the wrapper changes them; put back at the end.
    monkeypatch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", lpip.LearnedPerceptualImagePatchSimilarity)
    name = "structural_similarity_index_measure"
    monkeypatch.setattr(functional, name, getattr(functional, name))
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "0")
    prepare()
    # Of little contrast, where the range of a picture is far from 1.
    predicted, reference = 0.4 + 0.2 * torch.rand(2, 24, 32, 3, generator=torch.Generator().manual_seed(0))
    images = [image.moveaxis(-1, 0)[None] for image in (predicted, reference)]
    model = NerfactoModelConfig(implementation="torch", log2_hashmap_size=8).setup(
        scene_box=SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])), num_train_data=1
    )
    ssim = model.ssim(*images)
    assert ssim.item() == pytest.approx(ImageMetrics(with_lpips=False)(predicted, reference)["ssim"])


def test_error_map() -> None:
    truth = np.full((2, 2, 3), 100, np.uint8)
    rendered = truth.copy()
    rendered[0, 0] += 64
    picture = error_map(rendered, truth).sum(-1)
    assert picture[0, 0] > 600
    assert (picture.ravel()[1:] < 10).all()


def test_draw_figures_of_any_seed(tmp_path: Path) -> None:
    # As one process finds them while the others are still at work.
    made = [
        run for run in small_plan(tables=("losses",)) if (run.dataset.scene, run.seed) in (("room", 1), ("object", 2))
    ]
    figures = {}
    for run in made:
        pictures = tmp_path / "runs" / run.name / "pictures"
        pictures.mkdir(parents=True)
        Image.new("RGB", (2 * 32, 24)).save(pictures / "eval_img_0000.png")
        figures[run.name] = {**figures_of(run, 20.0, "large", (1.0, 0.5)), "curve": [(10, 15.0)]}
    drawn = draw(tmp_path, small_plan(tables=("losses",)), figures)
    names = [f"{scene}_hard_losses_{kind}.png" for scene in ("room", "object") for kind in ("views", "psnr")]
    assert [path.name for path in drawn] == ["hard_losses.jpg", *names]
    # The truth and four rows, of two scenes.
    assert Image.open(drawn[0]).size == (5 * 192 + 4 * 4, 14 + 2 * 144 + 4)
    assert all(path.stat().st_size > 0 for path in drawn)
    # Not even one scene is complete.
    half = {run.name: figures[run.name] for run in made if (run.dataset.scene == "room") == (run.row == "all")}
    assert len(draw(tmp_path, small_plan(tables=("losses",)), half)) == len(names)


def small_bench(folder: Path, *tables: str) -> list[str]:
    """The command of a small benchmark."""
    (folder / "object").mkdir()  # A folder by the name of a built-in scene is no scene.
    return [
        sys.executable, "-m", "benchmarks.paper", "--output", "bench", "--scale", "tiny", "--device", "cpu",
        "--scenes", "object", "--speeds", "hard", "--steps", "8", "--tables", *tables,
        "--simulate=--width 32 --height 24 --duration 0.5 --validation-views 3 --test-views 3 --train-images 6",
    ]  # fmt: skip


# Behind what is there already: the package as it is installed comes first.
PATHS = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(ROOT))))


def start(command: list[str], folder: Path) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": PATHS, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, cwd=folder, env=environment, start_new_session=True)


def wait_for(pattern: str, folder: Path, process: subprocess.Popen) -> list[Path]:
    """Wait until a running process has made a file."""
    deadline = time.monotonic() + 600
    while not (found := list(folder.glob(pattern))):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def assert_gone(group: int) -> None:
    """Assert that no process of a group is left after the seconds that a busy machine takes to clear it away."""
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    raise AssertionError("a process is still there")


@pytest.mark.slow
def test_two_processes_resume_a_benchmark_after_each_kill(tmp_path: Path) -> None:
    """A kill at any stage of a run takes the command along, and the next starts go on from what is whole."""
    command, bench, finished = small_bench(tmp_path, "methods", "losses"), tmp_path / "bench", {}
    for stage in (
        "logs/*",
        "datasets/.*.partial/events.h5",
        "datasets/*/transforms.json",
        "outputs/*/*/*/config.yml",
        "outputs/*/*/*/*/*.ckpt",
        "runs/*/pictures/*.png",
        "runs/*.json",
    ):
        process = start(command, tmp_path)
        wait_for(stage, bench, process)
        process.kill()
        process.wait()
        assert_gone(process.pid)
        # What is there under its final name is whole, and later starts leave it as it is.
        for file in (*bench.glob("datasets/*/transforms.json"), *bench.glob("runs/*.json")):
            json.loads(file.read_text())
            assert finished.setdefault(file, file.stat().st_mtime_ns) == file.stat().st_mtime_ns
        for file in bench.glob("datasets/*/transforms.json"):
            NativeDataParserConfig(data=file.parent).setup().read_recording()
    both = [start(command, tmp_path) for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    assert all(file.stat().st_mtime_ns == time for file, time in finished.items())
    figures = [json.loads(path.read_text()) for path in bench.glob("runs/*.json")]
    assert {one["row"] for one in figures} == {OURS, WITHOUT_CORRECTION, TRUE_POSES, CEILING, *LOSSES}
    assert {one["kind"] for one in figures} == {"object"}
    for one in figures:
        assert len(one["curve"]) >= 4
        assert one["results"]["psnr"] > 5
        assert ("psnr_network" in one["results"]) == (one["row"] != CEILING)
    # Whichever ended last has written all of it.
    assert "missing" not in (bench / "report.md").read_text()
    assert not [path for path in bench.rglob("*") if ".partial" in path.name]
    kinds = {"methods": ("paths", "psnr", "views"), "losses": ("psnr", "views")}
    of_scene = {f"object_hard_{table}_{kind}.png" for table in kinds for kind in kinds[table]}
    drawn = {path.name for path in (bench / "figures").iterdir()}
    assert drawn == {"hard_methods.jpg", "hard_losses.jpg", *of_scene}
