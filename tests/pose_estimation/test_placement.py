"""Which model of COLMAP is taken, and what is reported of it."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import torch
from helpers.colmap_stand_in import model_of

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.pose_estimation.placement import EstimatedPoses, _refine, _sound

FRAME = 40_000_000
CAMERA = CameraIntrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)


def test_a_fragment_does_not_count_as_sound() -> None:
    # The whole path has a gap, across which nothing is shared.
    whole, fragment = (
        model_of(*[range(100)] * 20, *[range(100, 200)] * 20, *[range(200)] * 10),
        model_of(*[range(100)] * 5),
    )
    for index, image in list(whole.images.items())[20:]:
        image.name = f"{index + 10:08d}.png"
    assert _sound({"global": whole, "incremental": fragment}) == {"global": False, "incremental": False}
    assert _sound({"incremental": fragment}) == {"incremental": True}


def test_images_that_find_a_place_later_bring_no_break() -> None:
    model, sound = (model_of(*[range(200)] * count) for count in (49, 50))
    broken = model_of(*[range(100)] * 20, *[range(100, 200)] * 20, *[range(200)] * 10)
    for more, expected in ((sound, sound), (broken, model)):
        workspace = SimpleNamespace(
            adjust=lambda model, *_: model, triangulate=lambda *_: None, reconstruct=lambda start, more=more: [more]
        )
        assert _refine(workspace, model, 50) is expected


def test_report_lost_frames_and_fragments() -> None:
    times, poses = FRAME * np.arange(10), torch.eye(4, dtype=torch.float64)[:3].repeat(20, 1, 1)
    found = EstimatedPoses(times, Trajectory(times[[1, 2, 5, 6, 8]], poses[:5]), CAMERA, [5, 3], 100, 0.5, 200.0, 1.0)
    assert found.gaps() == [(0, 0, 1), (3 * FRAME, 4 * FRAME, 2), (7 * FRAME, 7 * FRAME, 1), (9 * FRAME, 9 * FRAME, 1)]
    report = found.report()
    assert json.loads(json.dumps(report)) == report
    assert (report["frames"], report["registered_frames"], report["registered_fraction"]) == (10, 5, 0.5)
    assert report["model_sizes"] == [5, 3]
    assert "5 of 10 frames registered in the largest of 2 models" in found.summary()
    assert "0.120 to 0.160 s (2)" in found.summary()
    # Across one lost frame poses are interpolated: two poses are then two frames apart.
    strict = dataclasses.replace(found, max_lost=1)
    assert [estimated.max_pose_gap() for estimated in (found, strict)] == [None, 2 * FRAME]
    assert f"at most {2 * FRAME * 1e-9:.3g} s apart poses are interpolated" in strict.summary()
    assert dataclasses.replace(found, max_lost=2).max_pose_gap() is None
    many = Trajectory(FRAME * np.arange(0, 40, 2), poses)
    told = dataclasses.replace(found, frame_times=FRAME * np.arange(40), trajectory=many).summary()
    assert told.count("(1)") == 10
    assert "and 10 more runs" in told
    torn = dataclasses.replace(found, breaks=(FRAME, 5 * FRAME))
    assert torn.report()["breaks_ns"] == [FRAME, 5 * FRAME]
    assert "The path breaks after 0.040 s, 0.200 s: fewer than 15 points hold the frames" in torn.summary()
    whole = dataclasses.replace(found, frame_times=times[[1, 2, 5, 6, 8]], model_sizes=[5])
    assert whole.gaps() == []
    assert "\n" not in whole.summary()
