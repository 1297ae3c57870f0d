"""Frames and times of videos: what a lossless file and a folder of images hold, and what is refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from aenerf_ns.cli import video_file
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.video import open_video

WIDTH, HEIGHT = 32, 20


def make_frames(count: int) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for _ in range(count)]


def write_video(path: Path, frames: list[NDArray[np.uint8]], frame_rate: float = 30.0) -> Path:
    """Write a lossless video.

    Not by OpenCV, whose ffmpeg prints errors for good if its first use in a process is not silent.
    """
    writer = imageio_ffmpeg.write_frames(
        str(path), (WIDTH, HEIGHT), fps=frame_rate, codec="ffv1", pix_fmt_out="bgr0", macro_block_size=1
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    return path


def write_folder(folder: Path, frames: list[NDArray[np.uint8]], times: list[str]) -> Path:
    folder.mkdir()
    for index, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{index}.png")
    (folder / "images.txt").write_text("".join(f"{time} {index}.png\n" for index, time in enumerate(times)))
    return folder


def test_read_a_video_file(tmp_path: Path) -> None:
    frames = make_frames(5)
    video = open_video(write_video(tmp_path / "video.avi", frames))
    assert (video.width, video.height) == (WIDTH, HEIGHT)
    assert video.times.tolist() == [0, 33_333_333, 66_666_667, 100_000_000, 133_333_333]
    for _ in range(2):
        np.testing.assert_array_equal(list(video), frames)


def test_a_colon_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("run1:2.mp4")
    assert video_file.write_video(path, make_frames(3), 30.0) == len(open_video(path).times) == 3


def test_ffmpeg_on_a_full_disk_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "full.mp4").symlink_to("/dev/full")
    with pytest.raises(OSError, match="ffmpeg wrote 0 of 3 frames"):
        video_file.write_video(tmp_path / "full.mp4", make_frames(3), 30.0)


def test_read_a_folder(tmp_path: Path) -> None:
    frames = make_frames(3)
    frames[1][...] = frames[1][..., :1]
    folder = write_folder(tmp_path / "frames", frames, ["1600000000.123456789", "1600000000.2", "1600000001"])
    Image.fromarray(frames[1][..., 0]).save(folder / "1.png")
    Image.fromarray(np.dstack([frames[2], frames[2][..., 0]])).save(folder / "2.png")
    video = open_video(folder)
    assert video.times.tolist() == [1_600_000_000_123_456_789, 1_600_000_000_200_000_000, 1_600_000_001_000_000_000]
    np.testing.assert_array_equal(list(video), frames)


def test_stated_rate_replaces_times(tmp_path: Path) -> None:
    frames = make_frames(4)
    for source in (
        write_video(tmp_path / "slow_motion.avi", frames),
        write_folder(tmp_path / "frames", frames, ["7", "7", "6", "5"]),
    ):
        video = open_video(source, frame_rate=960.0)
        assert video.times.tolist() == [0, 1_041_667, 2_083_333, 3_125_000]
        np.testing.assert_array_equal(list(video), frames)


def test_frames_are_read_lazily(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", make_frames(3), ["0", "1", "2"])
    frames = iter(open_video(folder))
    next(frames)
    (folder / "2.png").unlink()
    next(frames)
    with pytest.raises(DataError, match=r"2\.png: not a PNG or JPEG image that can be read"):
        next(frames)


def test_name_lost_frames_of_a_cut_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_video(tmp_path / "[a].avi", make_frames(20))
    open_video(path)
    assert "can be decoded" not in capsys.readouterr().out
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = len(open_video(path).times)
    assert 2 <= found < 20
    assert f"[a].avi: {found} of the 20 frames that it states can be decoded" in capsys.readouterr().out


def folder_with(times: list[str], change: Callable[[Path], object] = lambda folder: None) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        folder = write_folder(path / "frames", make_frames(len(times)), times)
        change(folder)
        return folder

    return write


def file_with(content: bytes) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        (path / "video.mp4").write_bytes(content)
        return path / "video.mp4"

    return write


def cut_file(path: Path) -> Path:
    video = write_video(path / "video.avi", make_frames(5))
    video.write_bytes(video.read_bytes()[:4000])
    return video


SMALLER, DEEP = np.zeros((HEIGHT, WIDTH - 1), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint16)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: path / "none.mp4", "none.mp4: there is no such video; give a file"),
        (file_with(b""), "video.mp4: not a video that can be read; convert it"),
        (file_with(bytes(range(256)) * 40), "video.mp4: not a video that can be read; convert it"),
        (cut_file, "video.avi: (not a video that can be read|no frame of it can be decoded|[01] frames)"),
        (file_with(b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n"), "video.mp4: not a video that can be read"),
        (lambda path: write_video(path / "video.avi", make_frames(1)), "video.avi: 1 frames; events happen between"),
        (lambda path: path, "images.txt: there is no such file; write a line for each frame into it"),
        (folder_with([]), "images.txt: it lists no frames; write a line"),
        (folder_with(["0"]), "frames: 1 frames; events happen between"),
        (folder_with(["0", "2", "2"]), "frames: frame 2 is at 2000000000 ns, not after .* 2000000000 ns; sort"),
        (folder_with(["0", "soon"]), "images.txt: soon is not a time in seconds"),
        (folder_with(["0", "1"], lambda folder: (folder / "1.png").unlink()), "it names 1.png, which does not exist"),
        (
            folder_with(["0", "1"], lambda folder: Image.fromarray(SMALLER).save(folder / "1.png")),
            "frames: frame 1 has 31 x 20 pixels, the first one 32 x 20; bring",
        ),
        (
            folder_with(["0", "1"], lambda folder: Image.fromarray(DEEP).save(folder / "0.png")),
            r"0.png: the image is of PIL's mode I;16; store 8 bits",
        ),
    ],
)
def test_refuse_unusable_video(
    write: Callable[[Path], Path], message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DataError, match=message):
        list(open_video(write(tmp_path)))
    # OpenCV and ffmpeg print from C.
    assert not capfd.readouterr().err


@pytest.mark.parametrize("frame_rate", [0.0, -1.0, float("nan"), float("inf"), 1e10])
def test_refuse_impossible_rate(frame_rate: float, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", make_frames(2), ["0", "1"])
    # At the highest one two frames share a nanosecond.
    problem = (
        f"a frame rate of {frame_rate}; give a positive" if frame_rate != 1e10 else "frame 1 is at 0 ns, not after"
    )
    with pytest.raises(DataError, match=f"frames: {problem}"):
        open_video(folder, frame_rate)


@pytest.mark.filterwarnings("error")
def test_refuse_one_image(tmp_path: Path) -> None:
    Image.fromarray(make_frames(1)[0]).save(tmp_path / "0.png")
    # OpenCV gives its only frame a time that no whole number of nanoseconds can hold.
    for frame_rate in (None, 30.0):
        with pytest.raises(DataError, match=r"0\.png: 1 frames; events happen between frames"):
            open_video(tmp_path / "0.png", frame_rate)


def test_frames_without_times_need_a_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = cv2.VideoCapture

    class Timeless:
        """Has a capture. To inherit from OpenCV's class breaks Python's memory."""

        def __init__(self, *arguments: Any) -> None:
            self._capture = opened(*arguments)

        def get(self, prop: int) -> float:
            return np.nan if prop == cv2.CAP_PROP_POS_MSEC else self._capture.get(prop)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._capture, name)

    path = write_video(tmp_path / "video.avi", make_frames(3))
    monkeypatch.setattr(cv2, "VideoCapture", Timeless)
    with pytest.raises(DataError, match=r"video\.avi: it states no times of its frames; state their rate"):
        open_video(path)
    assert open_video(path, 10.0).times.tolist() == [0, 100_000_000, 200_000_000]
