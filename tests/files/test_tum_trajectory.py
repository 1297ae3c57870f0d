"""Trajectories in text files, and times in seconds."""

from pathlib import Path

import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.files.text import format_seconds, parse_times
from aenerf_ns.files.tum_trajectory import read_tum_trajectory


def test_seconds_are_exact() -> None:
    texts = ["1600000000.123456789", "0", "1e-9", "-0.5", "12."]
    parsed = parse_times(Path("t"), texts)
    assert parsed.tolist() == [1_600_000_000_123_456_789, 0, 1, -500_000_000, 12_000_000_000]
    assert parse_times(Path("t"), [format_seconds(int(t)) for t in parsed]).tolist() == parsed.tolist()


POSE = "3.5 -0.25 1.5 -0.5 0.5 0.5 0.5"
W_FIRST = "0.492 3.5 -0.25 1.5 0.5 -0.5 0.5 0.5\n0.496 3.5 -0.25 1.5 0.5 -0.5 0.5 0.5\n"
POSES = {
    "byte-order mark": f"\ufeff0.492 {POSE}\n0.496 {POSE}\n",
    "commas": f"0.492 {POSE}\n0.496 {POSE}\n".replace(" ", ","),
    "commas and blanks": f"0.492 {POSE}\n0.496 {POSE}\n".replace(" ", ", "),
    "names": f"timestamp tx ty tz qx qy qz qw\n0.492 {POSE}\n0.496 {POSE}\n",
    "EuRoC": "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n"
    "492000000,3.5,-0.25,1.5,0.5,-0.5,0.5,0.5\n496000000,3.5,-0.25,1.5,0.5,-0.5,0.5,0.5\n",
    "another order in a remark": f"# t x y z qx qy qz qw (not qw qx qy qz)\n0.492 {POSE}\n0.496 {POSE}\n",
    "w first, below another remark": f"# mine\n# T TX TY TZ QW QX QY QZ\n{W_FIRST}",
    "two orders in remarks": f"# made of qw qx qy qz\n# t tx ty tz qx qy qz qw\n0.492 {POSE}\n0.496 {POSE}\n",
    "names first": f"# t tx ty tz qx qy qz qw\n# qw qx qy qz\n# exposure [ms]: 5\n0.492 {POSE}\n0.496 {POSE}\n",
    "w first, and a remark": f"# t tx ty tz qw qx qy qz (w first)\n{W_FIRST}",
    "w first in ROS": f"timestamp,p.x,p.y,p.z,orientation.w,orientation.x,orientation.y,orientation.z\n{W_FIRST}",
    "w first as r": f"time,x,y,z,rw,rx,ry,rz\n{W_FIRST}",
    "w first by units": f"t,x,y,z,qr,qi,qj,qk\n{W_FIRST}",
    "w last by units, and a remark": f"# t x y z q_i q_j q_k q_r (unit)\n0.492 {POSE}\n0.496 {POSE}\n",
    "w first by numbers": f"t,x,y,z,q0,q1,q2,q3\n{W_FIRST}",
    "w first with dots": f"# t x y z q.w q.x q.y q.z\n{W_FIRST}",
    "w first behind a label": f"# Format: timestamp [s] tx ty tz qw qx qy qz\n{W_FIRST}",
    "w first behind secs": f"# secs, tx, ty, tz, qw, qx, qy, qz\n{W_FIRST}",
    "w first behind utime": f"#utime tx ty tz qw qx qy qz\n# eight words of a remark that names nothing\n{W_FIRST}",
    "names that state the unit": f"stamp_ms, tx, ty, tz, qx, qy, qz, qw\n492 {POSE}\n496 {POSE}\n",
    "unit in parentheses": f"# time (ms) tx ty tz qx qy qz qw\n492 {POSE}\n496 {POSE}\n",
    "unit in a remark": f"# timestamps (ms precision)\n0.492 {POSE}\n0.496 {POSE}\n",
    "w first": f"t,tx,ty,tz,qw,qx,qy,qz\n{W_FIRST}".replace(" ", ","),
}


@pytest.mark.parametrize("spelling", POSES)
def test_read_the_spellings_that_are_unambiguous(spelling: str, tmp_path: Path) -> None:
    (tmp_path / "plain.txt").write_text(f"0.492 {POSE}\n0.496 {POSE}\n")
    (tmp_path / "poses.txt").write_text(POSES[spelling], encoding="utf-8")
    plain, read = (read_tum_trajectory(tmp_path / name) for name in ("plain.txt", "poses.txt"))
    assert read.times.tolist() == plain.times.tolist() == [492_000_000, 496_000_000]
    assert (read.camera_to_worlds == plain.camera_to_worlds).all()


def test_refuse_another_order_of_the_quaternion(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(f"t,x,y,z,qz,qy,qx,qw\n0.492 {POSE}\n0.496 {POSE}\n")
    with pytest.raises(DataError, match="the quaternion's columns in the order z y x w; write them in the order qx qy"):
        read_tum_trajectory(tmp_path / "poses.txt")
