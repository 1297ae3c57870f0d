"""The scenes on which the correction of poses is chosen, and the other scenes on which it is reported."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

Split = Literal["choose", "report"]

_NOISE = ("--pose-noise-degrees", "1.5", "--pose-noise-translation", "0.04")
_SLOW_NOISE = (*_NOISE, "--pose-noise-correlation-time", "0.5")
_SMALL = ("--width", "96", "--height", "72")
_MIDDLE = ("--width", "160", "--height", "120")


@dataclass(frozen=True)
class PoseScene:
    """A recording with wrong poses.

    Attributes:
        split: whether settings are chosen on it or reported on it.
        scene: a built-in scene, a scene of ``benchmarks.scenes.build``, or OUTWARDS.
        options: of aenerf simulate.
        about: the reason for the recording, in a few words.
    """

    split: Split
    scene: str
    options: tuple[str, ...]
    about: str


OUTWARDS = "outwards"
"""The living room, seen from a loop around its middle by a camera that looks outwards: no place is seen again before
the loop closes."""

SCENES = {
    "object": PoseScene(
        "choose", "object", ("--speed", "hard", *_SMALL, *_NOISE, "--seed", "77"), "small in the picture, no floor"
    ),
    "room": PoseScene("choose", "room", ("--speed", "hard", *_SMALL, *_NOISE, "--seed", "5"), "seen from within"),
    "outwards": PoseScene(
        "choose", OUTWARDS, ("--speed", "easy", *_SMALL, *_SLOW_NOISE, "--seed", "6"), "slow noise, no revisits"
    ),
    "forklift": PoseScene(
        "choose",
        "forklift",
        ("--speed", "hard", *_SMALL, *_NOISE, "--bayer-pattern", "RGGB", "--seed", "7"),
        "color, on a floor",
    ),
    "games": PoseScene(
        "report", "games", ("--speed", "hard", *_SMALL, *_NOISE, "--seed", "11"), "large in the picture"
    ),
    "plants": PoseScene(
        "report",
        "plants",
        ("--speed", "easy", *_SMALL, *_NOISE, "--bayer-pattern", "RGGB", "--seed", "12"),
        "color, fine structures",
    ),
    "workshop": PoseScene("report", "workshop", ("--speed", "hard", *_SMALL, *_NOISE, "--seed", "13"), "a large place"),
    "gallery": PoseScene(
        "report", "gallery", ("--speed", "easy", *_SMALL, *_SLOW_NOISE, "--seed", "14"), "a long place, slow noise"
    ),
    "room large noise": PoseScene(
        "report",
        "room",
        (
            "--speed", "easy", *_MIDDLE, "--pose-noise-degrees", "3", "--pose-noise-translation", "0.08", "--seed", "15"
        ),
        "large noise, middle size",
    ),
    "object COLMAP 25 Hz": PoseScene(
        "report",
        "object",
        ("--speed", "hard", *_MIDDLE, "--poses", "colmap", "--frame-rate", "25", "--seed", "16"),
        "COLMAP's own errors",
    ),
    "room COLMAP 125 Hz": PoseScene(
        "report",
        "room",
        ("--speed", "hard", *_MIDDLE, "--poses", "colmap", "--frame-rate", "125", "--seed", "17"),
        "COLMAP's own errors",
    ),
}  # fmt: skip


def scene_argument(scene: str, built: Path, folder: Path) -> str:
    """Return what ``aenerf simulate --scene`` takes for a scene.

    Args:
        scene: of a :class:`PoseScene`.
        built: folder of ``benchmarks.scenes.build``.
        folder: for a scene file that has to be written.
    """
    if scene in ("object", "room"):
        return scene
    if scene != OUTWARDS:
        return str((built / scene / "scene.json").resolve())
    source, target = built / "living_room", folder / OUTWARDS
    target.mkdir(parents=True, exist_ok=True)
    for file in source.iterdir():
        if file.name != "scene.json" and not (target / file.name).exists():
            os.symlink(file.resolve(), target / file.name)
    description = json.loads((source / "scene.json").read_text("utf8"))
    turn = 2 * np.pi * np.arange(16) / 16
    eyes = np.column_stack([0.8 * np.cos(turn), 0.55 * np.sin(turn), 1.4 + 0.14 * np.sin(3 * turn + 0.7)])
    # Ahead of the camera and outwards.
    gaze = turn + 0.6
    targets = np.column_stack([2.2 * np.cos(gaze), 1.8 * np.sin(gaze), 1 + 0.3 * np.sin(3 * turn - 0.6)])
    description["path"] = {
        "kind": "walk",
        "positions": eyes.round(3).tolist(),
        "targets": targets.round(3).tolist(),
        "duration": 4.0,
    }
    (target / "scene.json").write_text(json.dumps(description), "utf8")
    return str((target / "scene.json").resolve())
