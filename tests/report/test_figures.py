"""The figures of a report, before they are shown."""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from helpers.small_pipelines import make_pipeline
from helpers.streams import make_stream

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.writer import NativeDatasetWriter
from aenerf_ns.report.comparison import Protocol, paired_differences, protocol_differences, shared_views, views_left_out
from aenerf_ns.report.measuring import RunReport
from aenerf_ns.report.pair_residuals import average_by_length, average_by_tile, measure_pair_residuals
from aenerf_ns.report.poses import RunPoses, correction_components, measure_poses
from aenerf_ns.report.run_files import TrainingRecord, read_record, read_scalars
from aenerf_ns.report.view_pictures import choose_views

SECOND = 10**9


def evo_statistics(reference: Any, path: Any, with_scale: bool = True) -> dict[str, dict[str, float]]:
    """What ``evo_ape -as`` and ``evo_rpe -as`` print, or without scale -a alone, under the names of a report."""
    from evo.core import metrics

    path.align(reference, correct_scale=with_scale)
    relation = metrics.PoseRelation
    found = {
        "ate": metrics.APE(relation.translation_part),
        "rpe_translation": metrics.RPE(relation.translation_part),
        "rpe_rotation_degrees": metrics.RPE(relation.rotation_angle_deg),
    }
    for metric in found.values():
        metric.process_data((reference, path))
    return {name: metric.get_all_statistics() for name, metric in found.items()}


def test_correction_components(random_poses: torch.Tensor) -> None:
    twist = torch.tensor([0.01, -0.02, 0.03, 0.02, 0.0, -0.01], dtype=torch.float64)
    found = correction_components(random_poses, (homogeneous(random_poses) @ motion_from_twist(twist))[:, :3])
    assert list(found) == [f"{kind} {axis}" for kind in ("translation", "rotation") for axis in "xyz"]
    for name, expected in zip(found, [*twist[:3], *torch.rad2deg(twist[3:])], strict=True):
        # The twist's translation turns with it: a difference of second order.
        assert found[name] == pytest.approx([float(expected)] * 8, abs=6e-4), name


def test_average_residuals_by_length_and_tile() -> None:
    length = np.array([1] * 20 + [3] * 20 + [20] * 5 + [400] * 10)
    residual = np.arange(55.0)
    rows = average_by_length(length, residual)
    # Five pairs say too little.
    assert rows == [
        {"events": "1", "num_pairs": 20, "mean_residual": 9.5},
        {"events": "3 to 4", "num_pairs": 20, "mean_residual": 29.5},
        {"events": "65 or more", "num_pairs": 10, "mean_residual": 49.5},
    ]

    # Tiles of two pixels: the last one on the sensor, and one beside the first.
    pixel = np.array([24 * 12 - 1] * 10 + [2] * 10)
    tiles = average_by_tile(pixel, np.array([1.0] * 10 + [3.0] * 10), 24, 12)
    assert (len(tiles), len(tiles[0])) == (6, 12)
    assert tiles[5][11] == 1.0
    assert tiles[0][1] == 3.0
    assert sum(value is not None for row in tiles for value in row) == 2


def test_pairs_that_are_all_alike_have_no_correlation(tmp_path: Path) -> None:
    pipeline = make_pipeline(tmp_path / "data", "test").eval()
    residuals = measure_pair_residuals(pipeline.trained_run())
    # Of the only pair.
    assert residuals is not None
    assert residuals.correlation is None


def test_choose_worst_median_and_best_view() -> None:
    chosen = choose_views([20.0 + index % 7 for index in range(30)])
    assert [chosen[index] for index in (0, 27)] == ["worst", "best"]
    assert list(chosen.values()).count("median") == 1
    assert len(chosen) <= 9
    assert set(chosen.values()) == {"worst", "median", "best", "one of 5"}
    assert choose_views([20.0]) == {0: "worst"}


def test_errors_match_evo(random_poses: torch.Tensor, tmp_path: Path) -> None:
    pytest.importorskip("evo.core.metrics", reason="evo is not installed")
    from evo.core import sync
    from evo.tools.file_interface import read_tum_trajectory_file

    # More poses than the training compares, and many more than are drawn.
    times = np.linspace(0, 7 * SECOND, 2501).astype(np.int64)
    true = Trajectory(times, Trajectory(SECOND * np.arange(8), random_poses).interpolate(times))
    given = perturb(true, rotation_degrees=3.0, translation=0.2, correlation_time=0.05, seed=1)
    data = tmp_path / "data"
    with NativeDatasetWriter(data, CameraIntrinsics(6, 4, 5.0, 5.0, 3.0, 2.0), SensorModel(), "srgb") as writer:
        writer.events.append(make_stream([(1, 1, 0, 1), (1, 1, 7 * SECOND, -1)], 6, 4))
        writer.add_trajectories(given, true)
    run = make_pipeline(data, "test").trained_run()
    found = measure_poses(run)
    assert found.num_poses == 2501
    assert {len(values) for values in found.errors["estimated"].values()} == {len(found.seconds)} == {501}
    # In the recording's world, where other runs on the same true poses lie too.
    np.testing.assert_allclose(found.positions["true"], true.interpolate(times[::5])[:, :3, 3], atol=1e-5)
    # Turned upright they lie as in the scene of the given poses.
    paths = found.positions["estimated"] @ np.array(found.upright).T, run.scene.trajectory.camera_to_worlds[::5, :3, 3]
    shown, in_scene = (path / path.std() for path in (np.array(path) - np.array(path).mean(0) for path in paths))
    np.testing.assert_allclose(shown, in_scene, atol=1e-4)
    files = [data / f"trajectory_{name}.txt" for name in ("ground_truth", "estimated")]
    paths = sync.associate_trajectories(*map(read_tum_trajectory_file, files))
    for name, expected in evo_statistics(*paths).items():
        # The scene's transform is of float32.
        assert found.evo["estimated"][name] == pytest.approx(expected, rel=1e-4, abs=1e-5 * expected["max"]), name
    # In another unit, so that the scale counts.
    scaled = given.camera_to_worlds * torch.tensor([1.0, 1.0, 1.0, 2.5])
    errors = pose_errors(scaled, true.camera_to_worlds)
    for name, with_scale in (("sim3", True), ("se3", False)):
        reference, path = sync.associate_trajectories(*map(read_tum_trajectory_file, files))
        path.scale(2.5)
        expected = evo_statistics(reference, path, with_scale)["ate"]["rmse"]
        assert expected > 0.05
        assert errors[f"ate_rmse_{name}"] == pytest.approx(expected, rel=1e-9), name


def report_of(name: str, psnr: list[float]) -> RunReport:
    views = [{"file": f"{index}.png", "placed": {"psnr": value}} for index, value in enumerate(psnr)]
    poses = RunPoses(0, [], {}, [], None, None, None)
    return RunReport(name, Path(name), {}, None, None, [], poses, evaluation={"views": views})


def test_pair_differences_by_file() -> None:
    first, second = report_of("a", [20, 21, 25]), report_of("b", [21, 23, 26])
    # The order of the views says nothing.
    second.views.reverse()
    (row,) = paired_differences([first, second], ["0.png", "1.png", "2.png"])
    assert (row["run"], row["minus"], row["num_views"]) == ("b", "a", 3)
    assert row["mean"] == pytest.approx(4 / 3)
    # Student's t with two degrees of freedom: 4.303 standard errors.
    half = 4.302653 * np.std([1, 2, 1], ddof=1) / 3**0.5
    assert row["interval"] == pytest.approx((4 / 3 - half, 4 / 3 + half), rel=1e-6)
    assert paired_differences([first, second], ["0.png"])[0]["interval"] is None
    shared = ["1.png", "2.png"]
    (row,) = paired_differences([first, second], shared)
    assert (row["num_views"], row["mean"]) == (2, 1.5)
    assert views_left_out([first, second], shared) == {"a": ["0.png"], "b": ["0.png"]}
    assert paired_differences([first, second], []) == []


def test_name_protocol_differences() -> None:
    first = Protocol("affine", "as given", {"0.png": 10, "1.png": 11})
    assert protocol_differences(["a", "b"], [first, first]) == []
    # Another image under the same name is another view.
    other = Protocol("network", "as given", {"2.png": 12, "1.png": 11, "0.png": 99})
    colors, views = protocol_differences(["a", "c"], [first, other])
    assert colors == "color correction: affine (a), network (c)"
    assert views == "test views: 2 (a) and 3 (c); both runs have 1 images of the same name and content"
    assert shared_views([first, other]) == ["1.png"]
    assert shared_views([first]) == ["0.png", "1.png"]


RECORD = TrainingRecord(state="training", first_step=0, planned_steps=2000, steps=0, started="now", seconds=0.0)


def test_read_what_a_run_wrote(tmp_path: Path) -> None:
    assert "killed" in RECORD.describe_state()
    broken = {"run.json": ["[]", "{", "[" * 100_000, '{"steps": ' + "9" * 5000 + "}"]}
    values = {"state": "asleep", "steps": "many", "planned_steps": [1], "seconds": None, "started": 7, "machine": []}
    broken["run.json"] += [json.dumps({**msgspec.to_builtins(RECORD), name: value}) for name, value in values.items()]
    broken["scalars.csv"] = [f"step,name,value\n{line}\n" for line in ("1,loss", "a,loss,1", f"1,{'l' * 10**6},2")]
    for name, contents in broken.items():
        for content in contents:
            (tmp_path / name).write_text(content)
            with pytest.raises(DataError, match=name):
                (read_record if name == "run.json" else read_scalars)(tmp_path)
    lines = ["step,name,value", *(f"{step},loss,{step}" for step in range(4001))]
    (tmp_path / "scalars.csv").write_text("\n".join(lines))
    thinned = read_scalars(tmp_path)
    assert thinned["loss"][0][:2] == [0, 5]
