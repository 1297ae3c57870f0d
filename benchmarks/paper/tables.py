"""Markdown tables of a benchmark's figures, in the layout of the paper's tables 1, 3 and 4."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from statistics import fmean, stdev
from typing import Any

from benchmarks.paper import plan

Figures = dict[str, Any]
_METRICS = ("psnr", "ssim", "lpips")
# Why each metric has two figures.
_TEST_POSES = (
    "PSNR, SSIM and LPIPS: with test poses as placed / refined photometrically on the test images; - where only the "
    "first was measured."
)
_OWN_ROWS = (plan.WITHOUT_CORRECTION, plan.OURS, *plan.POSES_OF_EVENTS, plan.TRUE_POSES, plan.CEILING)
_AE_NERF = "AE-NeRF"
_SETTINGS = ("estimated poses", "estimated poses, pose correction", "true poses")
# Rows of a method in these settings, the method of the paper last.
_ROWS_OF = {
    name: (name, name + plan.CORRECTED, name + plan.ON_TRUE_POSES) for name in (plan.FILTERED, *plan.PEERS.values())
}
_ROWS_OF[_AE_NERF] = (plan.WITHOUT_CORRECTION, plan.OURS, plan.TRUE_POSES)
# The rows that are put in order: of other papers' methods, and of AE-NeRF.
_ORDERS = {
    "estimated poses, which only AE-NeRF corrects": (0, 1),
    "estimated poses, which all correct": (1, 1),
    "true poses": (2, 2),
}
# PSNR in the paper's tables 1 and 2. AE-NeRF's is with its correction.
_PAPER = {
    ("object", "easy"): (18.92, 26.81, 27.72, 28.38, None, 28.96),
    ("object", "hard"): (18.92, 24.92, 25.44, 28.37, None, 28.90),
    ("large", "easy"): (15.60, 17.99, 18.26, 21.48, None, 24.28),
    ("large", "hard"): (15.60, 17.68, 17.82, 21.41, None, 24.23),
}


def report(figures: Sequence[Figures], missing: Mapping[str, str]) -> str:
    """Return all tables of the runs that have been made, and why others are ``missing``, if they were tried."""
    all_rows, losses = ([run for run in figures if run["table"] == table] for table in ("methods", "losses"))
    # Few scenes have further rows, and the means of the others are over more.
    methods = [run for run in all_rows if run["row"] not in plan.POSES_OF_EVENTS]
    further = {(run["scene"], run["speed"]) for run in all_rows if run["row"] in plan.POSES_OF_EVENTS}
    parts = ["# Benchmark", _conditions(figures), _TEST_POSES]
    if missing:
        parts.append(f"**Not complete:** {len(missing)} of {len(missing) + len(figures)} runs are missing.")
    note = "Means over what all methods of a column have in common."
    if methods:
        parts += ["## Novel views (the paper's table 1)", note, methods_table(methods)]
    if further:
        beside = [run for run in all_rows if (run["scene"], run["speed"]) in further]
        parts += ["## Poses that the events refine or find", note, methods_table(beside)]
    if any(run["row"] not in _OWN_ROWS for run in methods):
        parts += ["## Methods of other papers", *peers_parts(methods)]
    if _of(methods, row=plan.OURS):
        parts += [
            "## Pose correction (the paper's table 3)",
            "RE: rotation error in degrees, TE: translation error in percent of the length of the path; both after "
            "Sim(3) alignment; with pose correction and without it.",
            poses_table(methods),
        ]
    if losses:
        parts += ["## Losses (the paper's table 4) of the paper's recipe, hard speed", losses_table(losses)]
    if figures:
        parts += ["## Every scene", scenes_table(figures)]
    # Poses that aenerf convert finds by the events have a report, too.
    sequences = {(run["scene"], run["speed"]): run for run in figures if run["poses_report"] and not run.get("convert")}
    if sequences:
        parts += ["## Poses from COLMAP", sequences_table(list(sequences.values()))]
    if missing:
        parts += ["## Missing", "\n".join(f"- {name}{why and f': {why}'}" for name, why in missing.items())]
    return "\n\n".join(parts) + "\n"


def methods_table(figures: Sequence[Figures]) -> str:
    """Return the means for each method, kind of scene and speed, over the scenes and seeds that all methods have.

    A method whose difficult scenes are missing would otherwise look better.
    """
    columns = [(kind, speed) for kind in ("object", "large") for speed in ("easy", "hard")]
    columns = [column for column in columns if _of(figures, kind=column[0], speed=column[1])]
    peers = (row for name, rows in _ROWS_OF.items() if name != _AE_NERF for row in rows)
    header, rows = ["method"], [[row] for row in (*peers, *_OWN_ROWS) if _of(figures, row=row)]
    for kind, speed in columns:
        common = _common(_of(figures, kind=kind, speed=speed))
        count = len({run["scene"] for run in common})
        header += [f"{count} {kind} scenes, {speed}: {metric.upper()}" for metric in _METRICS]
        for row in rows:
            row += [_mean(_of(common, row=row[0]), metric) for metric in _METRICS]
    return _markdown(header, rows)


def peers_parts(figures: Sequence[Figures]) -> list[str]:
    """Return a table of PSNR and the order of the methods for each kind of scene and speed, beside the paper's."""
    named = [name for name, rows in _ROWS_OF.items() if any(_of(figures, row=row) for row in rows)]
    parts = [
        "PSNR: mean over scenes and seeds ± standard deviation over seeds, with test poses as placed / refined / as "
        "placed, where the paper's network corrects the colors. Means over what all rows of a table have in common. Of "
        "these methods only AE-NeRF corrects poses. The column with pose correction gives the others this project's. "
        "The paper's PSNR of AE-NeRF is with correction. The paper does not say on which poses it ran the others. In "
        "the other tables, rows without a method's name are AE-NeRF's."
    ]
    if plan.FILTERED in named:
        parts.append(
            f"{plan.FILTERED} stands in the place of {plan.PEERS['e2vid-nerf']}. It is not the paper's row, because "
            "its images are a filter's and not a network's."
        )
    for (kind, speed), paper in _PAPER.items():
        common = _common([run for run in _of(figures, kind=kind, speed=speed) if run["row"] != plan.CEILING])
        if not common:
            continue
        published = {name: value for name, value in zip((*plan.PEERS.values(), _AE_NERF), paper, strict=True) if value}
        rows = [
            [
                name,
                f"{published[name]:.2f}" if name in published else "-",
                *(_mean_and_spread(_of(common, row=row)) for row in _ROWS_OF[name]),
            ]
            for name in named
        ]
        orders = [f"- the paper: {_order(published)}"]
        for setting, (peers_column, own_column) in _ORDERS.items():
            wanted = {name: _ROWS_OF[name][own_column if name == _AE_NERF else peers_column] for name in named}
            found = {name: some for name, row in wanted.items() if (some := _of(common, row=row))}
            means = {
                name: _mean_over_scenes(some, (run["results"]["psnr"] for run in some)) for name, some in found.items()
            }
            if len(means) > 1:
                orders.append(f"- here, {setting}: {_order(means)}")
        parts += [
            f"### Scenes of kind {kind}: {len({run['scene'] for run in common})}, {speed} speed",
            _markdown(["method", "the paper", *_SETTINGS], rows),
            "Order by PSNR with placed test poses:",
            "\n".join(orders),
        ]
    return parts


def _order(values: Mapping[str, float]) -> str:
    return " < ".join(f"{name} ({values[name]:.2f})" for name in sorted(values, key=values.__getitem__))


def _mean_and_spread(figures: Sequence[Figures]) -> str:
    """Return the mean PSNR with test poses placed / refined / placed under the paper's color correction, where that
    was measured, each with the standard deviation over seeds where these have the same scenes."""
    if not figures:
        return "-"
    parts = []
    results = [run["results"] for run in figures]
    refined = [result.get("refined_test_poses", {}).get("psnr") for result in results]
    for values in ([result["psnr"] for result in results], refined, [result.get("psnr_network") for result in results]):
        if None in values:
            parts.append("-")
            continue
        by_seed: dict[int, list[float]] = {}
        for run, value in zip(figures, values, strict=True):
            by_seed.setdefault(run["seed"], []).append(value)
        means = [fmean(values) for values in by_seed.values()]
        # Seeds of different scenes would differ as these do.
        comparable = len(means) > 1 and len(figures) == len(means) * len({run["scene"] for run in figures})
        spread = f" ± {stdev(means):.2f}" if comparable else ""
        parts.append(f"{_mean_over_scenes(figures, values):.2f}{spread}")
    # Runs of earlier versions were not evaluated under the network.
    return " / ".join(parts[:-1] if parts[-1] == "-" else parts)


def poses_table(figures: Sequence[Figures]) -> str:
    """Return the errors of the poses with and without correction, means over scenes and seeds."""
    corrected = _of(figures, row=plan.OURS)
    speeds = [speed for speed in ("easy", "hard") if _of(corrected, speed=speed)]
    header = ["", *(f"{speed}: {which} ψ" for speed in speeds for which in ("with", "without"))]
    rows = []
    for name, key in (("RE", "rotation_error_degrees"), ("TE", "translation_error_percent")):
        cells = []
        for speed, which in product(speeds, ("corrected", "estimated")):
            runs = _of(corrected, speed=speed)
            errors = (run["results"]["pose_errors"][which][key] for run in runs)
            cells.append(f"{_mean_over_scenes(runs, errors):.3f}")
        rows.append([name, *cells])
    return _markdown(header, rows)


def losses_table(figures: Sequence[Figures]) -> str:
    """Return the means for each set of losses, over the scenes and seeds that all sets have."""
    figures = _common(figures)
    rows = [
        [name, *(_mean(_of(figures, row=name), m) for m in _METRICS)] for name in plan.LOSSES if _of(figures, row=name)
    ]
    return _markdown(["losses", *map(str.upper, _METRICS)], rows)


def scenes_table(figures: Sequence[Figures]) -> str:
    """Return every row of every scene and speed, means over seeds with the standard deviation of placed PSNR."""
    errors_of_poses = ("RE before", "RE after", "TE before", "TE after")
    header = ["scene", "speed", "row", "seeds", *map(str.upper, _METRICS), *errors_of_poses]
    rows = []
    for scene, speed, row in dict.fromkeys((run["scene"], run["speed"], run["row"]) for run in figures):
        some = _of(figures, scene=scene, speed=speed, row=row)
        cells = [_mean(some, metric) for metric in _METRICS]
        if len(some) > 1:
            placed, refined = cells[0].split(" / ")
            cells[0] = f"{placed} ± {stdev(run['results']['psnr'] for run in some):.2f} / {refined}"
        errors = [run["results"].get("pose_errors") for run in some]
        poses = [
            f"{fmean(error[which][key] for error in errors):.3f}{unit}" if all(errors) else "n/a"
            for key, unit in (("rotation_error_degrees", "°"), ("translation_error_percent", " %"))
            for which in ("estimated", "corrected")
        ]
        rows.append([scene, speed, row, str(len(some)), *cells, *poses])
    return _markdown(header, rows)


def sequences_table(figures: Sequence[Figures]) -> str:
    """Return COLMAP's mean errors on each sequence, at the frames and between them, given one run of each sequence."""
    header = ["scene", "speed", "frames", "registered", "misplaced", "RE", "TE", "RE between", "TE between"]
    rows = []
    for run in figures:
        poses = run["poses_report"]
        cells = [str(poses["frames"]), str(poses["registered_frames"]), str(poses["errors"]["misplaced_frames"])]
        for errors in (poses["errors"], poses["errors_between_frames"]):
            cells += [f"{errors['rotation_error_degrees']:.2f}°", f"{100 * errors['translation_error']:.1f} cm"]
        rows.append([run["scene"], run["speed"], *cells])
    return _markdown(header, rows)


def _common(figures: Sequence[Figures]) -> list[Figures]:
    """Return the figures of the scenes, speeds and seeds that every row has."""
    made: dict[str, set[tuple]] = {}
    for run in figures:
        made.setdefault(run["row"], set()).add((run["scene"], run["speed"], run["seed"]))
    shared = set.intersection(*made.values()) if made else set()
    return [run for run in figures if (run["scene"], run["speed"], run["seed"]) in shared]


def _conditions(figures: Sequence[Figures]) -> str:
    """Return a list of where and how the figures were made."""
    trained = dict.fromkeys((run["method"], run["steps"]) for run in figures)
    lines = [f"- {method}, {steps} steps" for method, steps in trained]
    lines += [f"- data: `{command}`" for command in dict.fromkeys(_simulation(run) for run in figures)]
    made = dict.fromkeys(run["reconstruct"] for run in figures if run.get("reconstruct"))
    lines += [f"- images of the events: `aenerf reconstruct {options}`" for options in made]
    for run in {(str(run["machine"]), str(run["versions"]), run["commit"]): run for run in figures}.values():
        machine, versions = run["machine"], ", ".join(f"{name} {number}" for name, number in run["versions"].items())
        device = f"{machine['gpu'] if run['device'] == 'cuda' else machine['cpu']}, {machine['cores']} cores"
        lines.append(f"- {device}; {versions}; commit {run['commit']}")
    used = {run["results"].get("color_correction", "none (nerfacto)") for run in figures}
    lines.append(f"- color correction: {'; '.join(sorted(used))}")
    return "\n".join(lines)


def _simulation(figures: Figures) -> str:
    """Return the command that made the data, with SCENE, SPEED and SEED in place of their values."""
    words = shlex.split(figures["simulate"])
    for option in ("--scene", "--speed", "--seed"):
        words[words.index(option) + 1] = option[2:].upper()
    return shlex.join(words)


def _of(figures: Sequence[Figures], **wanted: str) -> list[Figures]:
    return [run for run in figures if all(run[key] == value for key, value in wanted.items())]


def _mean(figures: Sequence[Figures], metric: str) -> str:
    """Return the means of a metric with test poses placed / refined."""
    digits = 2 if metric == "psnr" else 3
    placed = [run["results"].get(metric) for run in figures]
    # Results of earlier versions and of nerfacto have no refined poses.
    refined = [run["results"].get("refined_test_poses", {}).get(metric) for run in figures]
    return " / ".join(
        f"{_mean_over_scenes(figures, values):.{digits}f}" if values and None not in values else absent
        for values, absent in ((placed, "n/a"), (refined, "-"))
    )


def _mean_over_scenes(figures: Sequence[Figures], values: Iterable[float]) -> float:
    """Return the mean of the runs' values in which a scene counts once, however many seeds it has."""
    of_scenes: dict[str, list[float]] = {}
    for run, value in zip(figures, values, strict=True):
        of_scenes.setdefault(run["scene"], []).append(value)
    return fmean(map(fmean, of_scenes.values()))


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
