"""Which frames of a COLMAP model have a pose, and how its world lies."""

import numpy as np
import pycolmap
import pytest
from helpers.colmap_stand_in import model_of
from scipy.spatial.transform import Rotation

from aenerf_ns.pose_estimation.colmap_model import breaks_of, is_sound, poses_of, stand_upright


def turned_by(degrees: float) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d([0, np.deg2rad(degrees), 0]), [0, 0, 0])


def test_frames_that_see_few_points_have_no_pose() -> None:
    assert list(poses_of(model_of(*map(range, [14, 15, 15, 15])))) == [1, 2, 3]


@pytest.mark.parametrize(("num_shared", "placed"), [(14, [0, 1, 2]), (15, [0, 1, 2, 3, 4])])
def test_a_group_of_frames_that_hangs_by_few_points_has_no_pose(num_shared: int, placed: list[int]) -> None:
    beside = range(100 - num_shared, 200 - num_shared)
    model = model_of(*[range(100)] * 3, *[beside] * 2)
    assert list(poses_of(model)) == placed
    assert list(poses_of(model, only_linked=False)) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("num_frames", "num_partners", "is_placed"), [(30, 4, False), (30, 5, True), (7, 2, True)])
def test_a_frame_that_shares_points_with_few_others_has_no_pose(
    num_frames: int, num_partners: int, is_placed: bool
) -> None:
    frames = [range(100)] * (num_frames - num_partners) + [range(115)] * num_partners
    assert len(poses_of(model_of(*frames, range(100, 200)))) == num_frames + is_placed


@pytest.mark.parametrize(
    ("turn", "pixels", "sound"), [(2.0, 0.7, True), (29.0, 0.7, True), (31.0, 0.7, False), (2.0, 5.0, False)]
)
def test_a_model_is_sound(turn: float, pixels: float, sound: bool) -> None:
    model = model_of(*[range(100)] * 6)
    model.compute_mean_reprojection_error = lambda: pixels
    # The second half looks another way.
    for image in list(model.images.values())[3:]:
        image.cam_from_world = lambda: turned_by(turn)
    assert is_sound(model, 4.0) is sound


@pytest.mark.parametrize(("shared", "turn", "has_pose"), [(20, 0.0, True), (0, 0.0, False), (20, 40.0, False)])
def test_a_frame_apart_from_those_before_and_after_it_has_no_pose(shared: int, turn: float, has_pose: bool) -> None:
    # Frames of another time see what it sees, too.
    model = model_of(*[range(100)] * 4, range(100 - shared, 200), *[range(100)] * 4, *[range(80, 200)] * 6)
    model.images[4].cam_from_world = lambda: turned_by(turn)
    assert (4 in poses_of(model)) == has_pose


def test_a_camera_in_fast_motion_has_poses() -> None:
    model = model_of(*[range(100)] * 5)
    for index, image in model.images.items():
        image.cam_from_world = lambda angle=40.0 * index: turned_by(angle)
    assert len(poses_of(model)) == 5


def test_a_path_breaks_where_frames_share_no_points() -> None:
    # The last frames come back to what the first ones see.
    whole, torn = (model_of(*[range(100)] * 6, *[range(first, 200)] * 6, *[range(200)] * 2) for first in (80, 100))
    assert (is_sound(whole, 4.0), breaks_of(whole)) == (True, [])
    assert (is_sound(torn, 4.0), breaks_of(torn)) == (False, [5])


@pytest.mark.parametrize(("num_held", "num_frames", "breaks"), [(14, 10, [9]), (15, 10, []), (14, 9, [])])
def test_a_path_breaks_where_few_points_hold_its_parts_together(
    num_held: int, num_frames: int, breaks: list[int]
) -> None:
    # Frames beside the break share more points, but one of the two sees each of these for the only time in its part.
    before, after = range(100), range(100 - num_held, 200)
    bridge = [*after, *range(200, 220)]
    model = model_of(*[before] * (num_frames - 1), [*before, *range(200, 220)], bridge, *[bridge] * 9)
    assert breaks_of(model) == breaks
    # As linked frames, all have poses.
    assert len(poses_of(model)) == num_frames + 10


def test_worlds_stand_upright(monkeypatch: pytest.MonkeyPatch) -> None:
    # These frames are no video.
    monkeypatch.setattr("aenerf_ns.pose_estimation.colmap_model._MAX_TURN", 180.0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    model = pycolmap.synthesize_dataset(options)
    for image in model.images.values():
        image.name = f"{image.image_id}.png"
    stand_upright(model)
    poses = np.stack(list(poses_of(model).values()))
    np.testing.assert_allclose(poses[:, :, 3].mean(0), 0, atol=1e-5)
    # The direction that the pictures' rows are most level to.
    assert np.square(poses[:, 2, 0]).sum() == pytest.approx(np.linalg.svd(poses[:, :, 0])[1][-1] ** 2, rel=1e-4)
    assert poses[:, 2, 1].mean() < 0
    # From above, no other heading holds the points in a smaller rectangle.
    points = np.stack([point.xyz for point in model.points3D.values()])
    turned = [Rotation.from_euler("z", angle, degrees=True).apply(points)[:, :2] for angle in range(90)]
    areas = [np.ptp(np.quantile(seen, [0.01, 0.99], axis=0), axis=0).prod() for seen in turned]
    assert areas[0] == pytest.approx(min(areas))
    assert model.compute_mean_reprojection_error() < 1e-3
