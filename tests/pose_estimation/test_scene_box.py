"""The box around what the camera goes around."""

from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from helpers.colmap_stand_in import model_of

from aenerf_ns.pose_estimation.scene_box import box_of
from aenerf_ns.simulator.paths import look_at


def model(
    radius: float, turn: float, num_wrong: int = 0, num_points: int = 2000, num_seen: int = 100
) -> SimpleNamespace:
    """A model of points in the cube of side 2, seen ten times each, and of cameras on a part of a circle around it.

    Wrong points are far out, and seen three times.
    """
    angles = np.linspace(0, turn, 20)
    poses = [look_at((radius * np.cos(a), radius * np.sin(a), 0.4), (0.0, 0.0, 0.0))[:3] for a in angles]
    # The last camera has no place of its own, within the cube.
    made = model_of(*[range(num_seen)] * 20, range(5))
    for index, pose in enumerate(poses):
        made.images[index].cam_from_world = pycolmap.Rigid3d(pose).inverse
    positions = np.random.default_rng(0).uniform(-1, 1, (num_points, 3))
    positions[:num_wrong] *= 100
    made.points3D = {
        index: SimpleNamespace(
            xyz=xyz, track=SimpleNamespace(length=lambda index=index: 3 if index < num_wrong else 10)
        )
        for index, xyz in enumerate(positions)
    }
    return made


@pytest.mark.parametrize("num_wrong", [0, 200])
def test_the_box_holds_what_is_seen_and_little_more(num_wrong: int) -> None:
    box = box_of(model(3.0, 2 * np.pi, num_wrong))
    np.testing.assert_allclose(box, [[-1.18] * 3, [1.18] * 3], atol=0.03)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"radius": 0.5}, id="within"),
        pytest.param({"radius": 1.1}, id="passing the margin"),
        pytest.param({"turn": 1.4}, id="from one side"),
        pytest.param({"num_points": 40}, id="few points"),
        pytest.param({"num_seen": 10}, id="no image sees enough"),
    ],
)
def test_no_box_where_the_camera_does_not_go_around(options: dict[str, float]) -> None:
    assert box_of(model(**{"radius": 3.0, "turn": 6.0, **options})) is None
