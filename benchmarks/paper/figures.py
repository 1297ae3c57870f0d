"""Figures of a benchmark: renderings beside the truth, paths before and after correction, quality during training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from benchmarks.paper.plan import OURS, Run, scene_name

_TRUTH = "truth"
_GAP = 4
_LABEL = 14
_MIN_WIDTH = 190
"""In pixels. Smaller pictures are enlarged, because the names above them would not fit."""
_MAX_COLUMNS = 7
"""More columns go on below."""


def draw(folder: Path, runs: Sequence[Run], figures: Mapping[str, dict[str, Any]]) -> list[Path]:
    """Draw the figures of the runs that have been made into ``folder / "figures"``, and return their files.

    Each kind of figure is drawn for every scene, speed and table. One more figure has a view of every scene.

    Args:
        folder: of the benchmark.
        runs: all runs.
        figures: results of the runs that have been made, by the name of the run.
    """
    output = folder / "figures"
    output.mkdir(exist_ok=True)
    # Published results come without pictures.
    made = [run for run in runs if run.name in figures and (folder / "runs" / run.name / "pictures").exists()]
    files = []
    for speed, table in dict.fromkeys((run.dataset.speed, run.table) for run in made):
        rows = [run for run in made if (run.dataset.speed, run.table) == (speed, table)]
        files += _scenes(folder, rows, output / f"{speed}_{table}.jpg")
    for scene, speed, table in dict.fromkeys((run.dataset.scene, run.dataset.speed, run.table) for run in made):
        rows = [run for run in made if (run.dataset.scene, run.dataset.speed, run.table) == (scene, speed, table)]
        # The first seed that has been made stands for all seeds.
        rows = [run for run in rows if run.seed == rows[0].seed]
        stem = f"{scene_name(scene)}_{speed}_{table}"
        files += [
            _views(folder, rows, output / f"{stem}_views.png"),
            _curves(rows, figures, output / f"{stem}_psnr.png"),
        ]
        for run in rows:
            if run.table == "methods" and run.row == OURS:
                data, corrected = folder / "datasets" / run.dataset.name, folder / "runs" / run.name / "corrected.txt"
                files.append(_paths(data, corrected, output / f"{stem}_paths.png"))
    return files


def _views(folder: Path, runs: Sequence[Run], file: Path) -> Path:
    """Draw a test view: the truth and each run's rendering, with its error map below."""
    columns: dict[str, list[NDArray[np.uint8]]] = {}
    for run in runs:
        truth, rendered = _view(folder, run)
        columns.setdefault(_TRUTH, [truth, np.zeros_like(truth)])
        columns[run.row] = [rendered, error_map(rendered, truth)]
    picture_grid(columns).save(file, optimize=True)
    return file


def _scenes(folder: Path, runs: Sequence[Run], file: Path) -> list[Path]:
    """Draw a test view of every scene whose rows have all been made: the truth and each run's rendering."""
    names = list(dict.fromkeys(run.row for run in runs))
    columns: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in (_TRUTH, *names)}
    for scene in dict.fromkeys(run.dataset.scene for run in runs):
        # The first seed stands for all seeds: later entries of a dict win.
        rows = {run.row: run for run in reversed(runs) if run.dataset.scene == scene}
        if set(rows) == set(names):
            views = {name: _view(folder, rows[name]) for name in names}
            columns[_TRUTH].append(views[names[0]][0])
            for name, (_, rendered) in views.items():
                columns[name].append(rendered)
    if not columns[_TRUTH]:
        return []
    picture_grid(columns).save(file, quality=88)
    return [file]


def _view(folder: Path, run: Run) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the truth and the rendering of the middle test view of a run."""
    pictures = sorted((folder / "runs" / run.name / "pictures").glob("eval_img_*.png"))
    both = np.asarray(Image.open(pictures[len(pictures) // 2]).convert("RGB"))
    truth, rendered = np.split(both, 2, axis=1)
    return truth, rendered


def picture_grid(columns: Mapping[str, Sequence[NDArray[np.uint8]]]) -> Image.Image:
    """Lay out columns of equally large pictures below their names, in bands of at most :data:`_MAX_COLUMNS`."""
    height, width = next(iter(columns.values()))[0].shape[:2]
    factor = -(-_MIN_WIDTH // width)
    height, width = factor * height, factor * width
    count = max(map(len, columns.values()))
    across = min(len(columns), _MAX_COLUMNS)
    band = _LABEL + count * (height + _GAP)
    size = (across * (width + _GAP) - _GAP, -(-len(columns) // across) * band - _GAP)
    picture = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(picture)
    for index, (name, tiles) in enumerate(columns.items()):
        below, column = divmod(index, across)
        left, top = column * (width + _GAP), below * band
        pen.text((left + 2, top + 1), name, fill="black")
        for row, tile in enumerate(tiles):
            enlarged = Image.fromarray(tile).resize((width, height), Image.Resampling.NEAREST)
            picture.paste(enlarged, (left, top + _LABEL + row * (height + _GAP)))
    return picture


def error_map(rendered: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an (H, W, 3) picture of the mean absolute error: black for none, white for a quarter of the range."""
    from matplotlib import colormaps

    error = np.abs(rendered.astype(np.float64) - truth).mean(-1) / 255
    return (colormaps["inferno"](np.clip(4 * error, 0, 1))[..., :3] * 255).round().astype(np.uint8)


def _paths(data: Path, corrected: Path, file: Path) -> Path:
    """Draw the true, the estimated and the corrected path of a run, and the errors of the poses."""
    from aenerf_ns.camera.alignment import align_most
    from aenerf_ns.files.tum_trajectory import read_tum_trajectory
    from aenerf_ns.report.poses import errors_over_time

    truth = read_tum_trajectory(data / "trajectory_ground_truth.txt")
    positions: dict[str, ArrayLike] = {"true": truth.camera_to_worlds[..., 3]}
    errors = {}
    for poses, path in {"estimated": data / "trajectory_estimated.txt", "corrected": corrected}.items():
        trajectory = read_tum_trajectory(path)
        times = trajectory.knots_covered_by(truth)
        found, reference = trajectory.interpolate(times), truth.interpolate(times)
        positions[poses] = align_most(found, reference)(found)[..., 3]
        errors[poses] = ((times - truth.start).double() * 1e-9, errors_over_time(found, reference))
    return draw_paths(positions, errors, file)


def draw_paths(
    positions: Mapping[str, ArrayLike], errors: Mapping[str, tuple[ArrayLike, Mapping[str, ArrayLike]]], file: Path
) -> Path:
    """Draw ``estimated``, ``corrected`` and ``true`` positions (N, 3) from above and from the side.

    Where errors of poses are known, ``rotation_degrees`` and ``translation``, they are drawn over their seconds.
    """
    from matplotlib.figure import Figure

    lines = {"true": ("darkgray", 3.0), "estimated": ("tab:red", 0.8), "corrected": ("tab:blue", 0.8)}
    figure = Figure(figsize=(10 if errors else 5, 5), layout="constrained")
    panels = figure.subplots(2, 2 if errors else 1, squeeze=False)
    for axes, up, side in zip(panels[:, 0], (1, 2), ("above", "the side"), strict=True):
        for name, (color, width) in lines.items():
            if name in positions:
                path = np.asarray(positions[name])
                axes.plot(path[:, 0], path[:, up], color=color, linewidth=width, label=name)
        axes.set(xlabel="x", ylabel="xyz"[up], title=f"path from {side}")
        axes.set_aspect("equal", adjustable="datalim")
    kinds = {"rotation_degrees": "rotation error [degrees]", "translation": "position error"} if errors else {}
    for axes, (kind, title) in zip(panels[:, -1], kinds.items(), strict=False):
        for name, (seconds, of) in errors.items():
            axes.plot(seconds, of[kind], color=lines[name][0], linewidth=0.8)
        axes.set(xlabel="seconds", title=title, ylim=(0, None))
    panels[0, 0].legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=80)
    return file


def _curves(runs: Sequence[Run], figures: Mapping[str, dict[str, Any]], file: Path) -> Path:
    """Draw PSNR during the trainings."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    axes.set_prop_cycle(color=colormaps["tab20"](range(20)))
    for run in runs:
        if figures[run.name]["curve"]:
            axes.plot(*zip(*figures[run.name]["curve"], strict=True), marker=".", label=run.row)
    axes.set(xlabel="steps", ylabel="PSNR [dB] on the validation views")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(file, dpi=100)
    return file
