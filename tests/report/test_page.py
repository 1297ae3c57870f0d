"""The page of a report, made of figures that need no run."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from aenerf_ns.checking.result import CheckResult
from aenerf_ns.events.polarity_drift import PolarityDrift
from aenerf_ns.events.statistics import EventStatistics
from aenerf_ns.recording.poses_report import PosesReport
from aenerf_ns.report.comparison import paired_differences, views_left_out
from aenerf_ns.report.measuring import RunReport
from aenerf_ns.report.page import make_page
from aenerf_ns.report.pair_residuals import PairResiduals
from aenerf_ns.report.poses import RunPoses
from aenerf_ns.report.run_files import Machine, TrainingRecord
from aenerf_ns.report.view_pictures import ViewPictures

HOSTILE = '<script>alert("&")</script>'


# Stands in for warped events. A page needs only their picture.
DRAWING = SimpleNamespace(picture=lambda: np.zeros((100, 2000, 3), np.uint8))


def picture() -> Image.Image:
    return Image.new("RGB", (6, 4), "red")


def make_report(name: str, **changes: Any) -> RunReport:
    """A report with everything in it, whose texts are not HTML."""
    path = [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]
    error = {"max": 2.0, "mean": 1.0, "median": 1.0, "min": 0.5, "rmse": 1.25, "sse": 3.0, "std": 0.1}
    kinds = {"ate": error, "rpe_translation": error, "rpe_rotation_degrees": error}
    over_time = {"rotation_degrees": [1.0, 2.0], "translation": [0.1, 0.2]}
    axes = [f"{kind} {axis}" for kind in ("translation", "rotation") for axis in "xyz"]
    views = [
        {
            "file": f"{index}{HOSTILE}.png",
            "time_ns": 10**9,
            "camera_speed": 0.5,
            "camera_turn_rate_degrees": None,
            "placed": {"psnr": 20.0 + index, "ssim": 0.5},
        }
        for index in range(2)
    ]
    pose_errors = {"rotation_error_degrees": 1.0, "translation_error": 0.1}
    evaluation = {
        "views": views, "psnr": 20.5, "psnr_std": 0.5, "test_poses": "as given", "color_correction": "affine",
        "pose_errors": {"estimated": pose_errors, "corrected": pose_errors}, "pose_diagnosis": {"summary": HOSTILE},
    }  # fmt: skip
    settings = {
        "data": HOSTILE, "method": "aenerf", "supervision": "pairs", "pose_correction": "spline", "seed": 1,
        "sensor": "6 x 4 pixels", "window_ns": [0, 10**9], "thresholds": [0.25, 0.25],
    }  # fmt: skip
    counts = np.array([[400, 600]])
    events = EventStatistics(counts, 400, 0, np.array([250, 750]), np.zeros((0, 2), np.int64), 0, 10**9)
    figures = {
        "config": settings,
        "record": TrainingRecord(
            state="finished", first_step=0, planned_steps=5, steps=5, started="now", seconds=9.0, command=HOSTILE,
            machine=Machine("cpu", 2), peak_memory_bytes={"host": 2**30, "gpu": None},
        ),
        "scalars": {"Train Loss Dict/reconstruction_loss": ([0, 1], [1.0, 0.5])},
        "pose_gaps_ns": [[1, 2]],
        "check": CheckResult(events, ["Events: 1000"], [HOSTILE], warped=DRAWING),
        "estimation": PosesReport(HOSTILE, picture()),
        "num_pairs": "1000 pairs",
        "drift": PolarityDrift(np.zeros((4, 6)), np.zeros((4, 6)), 0.06),
        "poses": RunPoses(2, [0.0, 1.0], {"estimated": path, "true": path}, np.eye(3).tolist(),
                          {"estimated": kinds, "corrected": kinds}, {"estimated": over_time},
                          {axis: [0.0, 0.1] for axis in axes}),
        "evaluation": evaluation,
        "contrast": [0.9],
        "chosen": {views[0]["file"]: "worst"},
        "pictures": {view["file"]: ViewPictures(picture(), picture(), picture(), picture(), (1, 2)) for view in views},
        "pairs": PairResiduals(9, [-1.0, 0.0, 1.0], [[1, 0], [3, 5]], 0.5, 0.75,
                               [{"events": "1", "num_pairs": 9, "mean_residual": 0.75}], [[0.75, None]]),
        "missing": [HOSTILE],
    }  # fmt: skip
    return RunReport(name, Path(HOSTILE), **figures | changes)


def page_of(reports: list[RunReport], shared: list[str]) -> str:
    return make_page(reports, paired_differences(reports, shared), views_left_out(reports, shared), (), shared)


def test_page_shows_everything_escaped() -> None:
    report = make_report(f"a {HOSTILE}")
    page = page_of([report], [])
    body = page[page.index("<body>") :]
    assert HOSTILE not in page
    assert body.count("&lt;script&gt;alert(&#34;&amp;&#34;)") > 8
    # Eight plots: curves, rate, trajectory, errors, correction, changes, tiles, lengths.
    assert body.count('class="plotly-graph-div"') == 8
    assert body.count('<img alt="" src="data:image/jpeg;base64,') == 7
    targets = re.findall(r'<a href="#(\w+)">', body)
    assert len(targets) == 8
    assert all(f'<h2 id="{target}">' in body for target in targets)
    for text in ("1,000 events in 1.000 s, 40.0% positive. 1 gaps of the poses", "finished: all 5 steps", "no GPU",
                 "1.00 GiB (host)", "PSNR 20.50 ± 0.50 dB", "differs by 12.0%", "absolute trajectory error 1.25 before",
                 "rendering: PSNR 20.00 dB, SSIM 0.500", 'data-value="21.0">21.00<', "correlation 0.500"):  # fmt: skip
        assert text in body, text
    # The column of turn rates is empty.
    assert "turn rate" not in body
    assert not re.search(r'(?:src|href)="(?!data:|#)', body)


def test_page_of_a_run_without_measurements() -> None:
    bare = dict.fromkeys(("record", "scalars", "check", "num_pairs", "drift", "pairs"))
    empty = {"pose_gaps_ns": [], "evaluation": {}, "chosen": {}, "pictures": {}, "missing": []}
    poses = RunPoses(0, [0.0], {"estimated": [[0.0] * 3]}, np.eye(3).tolist(), None, None, None)
    page = page_of([make_report("a", **bare, **empty, poses=poses)], [])
    for text in ("made by an earlier version", "No run kept its scalars", "There are no views with images",
                 "the recording has no true poses", "No run corrects poses", "Nothing is missing"):  # fmt: skip
        assert text in page, text


def test_page_of_pairs_that_are_all_alike() -> None:
    pairs = PairResiduals(1, [-1.0, 1.0], [[1]], None, 0.75, [], [[None]])
    assert "a: 1 pairs, mean residual 0.750 thresholds" in page_of([make_report("a", pairs=pairs)], [])


def test_page_compares_runs_on_shared_views() -> None:
    first, second = make_report("a"), make_report("b")
    shared = list(first.chosen)
    page = page_of([first, second], shared)
    assert "<td>b − a</td><td>PSNR</td><td>placed</td>" in page
    # The same data once, and four pictures for each run.
    assert page.count("All that aenerf check says") == 1
    assert page.count("<figure>") == 3 + 2 * 4
    # Of windows, say, which have no account of pairs.
    without_pairs = make_report("a", num_pairs=None, drift=None, pairs=None)
    assert page_of([without_pairs, second], shared).count("Pairs: 1000 pairs.") == 1
    assert "No test view is in all runs" in page_of([first, second], [])
