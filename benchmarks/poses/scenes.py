"""The scenes on which the correction of poses is chosen, and the other scenes on which it is reported."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.paper.plan import Poses

Split = Literal["choose", "report", "events"]


@dataclass(frozen=True)
class PoseScene:
    """A recording with wrong poses.

    Attributes:
        split: whether settings are chosen on it or reported on it. "events" are reported too, with poses that are
            refined by the events or found from these.
        scene: a built-in scene, a scene of ``benchmarks.scenes.build``, or OUTWARDS.
        speed: of the camera.
        options: of aenerf simulate.
        about: the reason for the recording, in a few words.
    """

    split: Split
    scene: str
    speed: str
    options: tuple[str, ...]
    about: str

    @property
    def poses(self) -> Poses:
        """Where the estimated poses come from."""
        return "colmap" if "colmap" in self.options else "noise"


OUTWARDS = "outwards"
"""The living room, seen from a loop around its middle by a camera that looks outwards: nothing is seen again before
the loop closes."""

_NOISE = "--pose-noise-degrees 1.5 --pose-noise-translation 0.04"
_SLOW_NOISE = f"{_NOISE} --pose-noise-correlation-time 0.5"
_SMALL = "--width 96 --height 72"
_MIDDLE = "--width 160 --height 120"
_FEW_FRAMES = "--max-displacement 1"
_SENSOR_240 = f"--width 240 --height 180 {_FEW_FRAMES} --validation-views 4 --test-views 10"
_RGGB = "--bayer-pattern RGGB"
_DAVIS346 = "--sensor davis346"
_JUMPS = "--pose-noise-kind gauss-markov --pose-noise-correlation-time 0.078"
_LARGE_NOISE = "--pose-noise-degrees 3 --pose-noise-translation 0.08"
SCENES = {
    name: PoseScene(split, scene, speed, tuple(options.split()), about)  # type: ignore[arg-type]
    for name, split, scene, speed, about, options in (
        ("object", "choose", "object", "hard", "small in the picture, no floor", f"{_SMALL} {_NOISE} --seed 77"),
        ("room", "choose", "room", "hard", "seen from within", f"{_SMALL} {_NOISE} --seed 5"),
        ("outwards", "choose", OUTWARDS, "easy", "slow noise, no revisits", f"{_SMALL} {_SLOW_NOISE} --seed 6"),
        ("forklift", "choose", "forklift", "hard", "color, on a floor", f"{_SMALL} {_NOISE} {_RGGB} --seed 7"),
        ("object davis346", "choose", "object", "hard", "a real sensor", f"{_SMALL} {_NOISE} {_DAVIS346} --seed 77"),
        ("room davis346", "choose", "room", "hard", "a real sensor", f"{_SMALL} {_NOISE} {_DAVIS346} --seed 5"),
        ("games", "report", "games", "hard", "large in the picture", f"{_SMALL} {_NOISE} --seed 11"),
        ("plants", "report", "plants", "easy", "color, fine structures", f"{_SMALL} {_NOISE} {_RGGB} --seed 12"),
        ("workshop", "report", "workshop", "hard", "a large place", f"{_SMALL} {_NOISE} --seed 13"),
        ("gallery", "report", "gallery", "easy", "a long place, slow noise", f"{_SMALL} {_SLOW_NOISE} --seed 14"),
        ("room easy", "report", "room", "easy", "seen from within, slowly", f"{_SMALL} {_NOISE} --seed 5"),
        ("room large noise", "report", "room", "easy", "large noise, middle size",
         f"{_MIDDLE} {_LARGE_NOISE} --seed 15"),
        ("object large noise", "events", "object", "hard", "large noise, middle size",
         f"{_MIDDLE} {_FEW_FRAMES} {_LARGE_NOISE} --seed 18"),
        ("room large noise davis346", "events", "room", "easy", "large noise, a real sensor",
         f"{_MIDDLE} {_FEW_FRAMES} {_LARGE_NOISE} {_DAVIS346} --seed 15"),
        ("object large noise davis346", "events", "object", "hard", "large noise, a real sensor",
         f"{_MIDDLE} {_FEW_FRAMES} {_LARGE_NOISE} {_DAVIS346} --seed 18"),
        ("room Gauss-Markov", "events", "room", "hard", "noise that jumps from pose to pose",
         f"{_MIDDLE} {_FEW_FRAMES} {_NOISE} {_JUMPS} --seed 19"),
        ("object COLMAP 25 Hz", "report", "object", "hard", "COLMAP's own errors",
         f"{_MIDDLE} --poses colmap --frame-rate 25 --seed 16"),
        ("room COLMAP 125 Hz", "report", "room", "hard", "COLMAP's own errors",
         f"{_MIDDLE} --poses colmap --frame-rate 125 --seed 17"),
        *(
            (f"{scene} 240 {name}", "events", scene, speed, about, f"{_SENSOR_240} {_NOISE} {options} --seed {seed}")
            for scene, easy, hard in (
                ("games", 34, 11), ("forklift", 31, 37), ("lounge", 35, 32), ("living_room", 36, 22),
                ("gallery", 33, 38), ("workshop", 13, 39), ("room", 40, 41),
            )
            for name, speed, about, options, seed in (
                ("easy", "easy", "240 x 180", "", easy),
                ("hard", "hard", "240 x 180", "", hard),
                ("davis346", "hard", "240 x 180, a real sensor", _DAVIS346, hard),
                ("Gauss-Markov", "hard", "240 x 180, noise that jumps from pose to pose", _JUMPS, hard),
            )
        ),
    )
}  # fmt: skip


def scene_argument(scene: str, built: Path, folder: Path) -> str:
    """Return the argument of ``aenerf simulate --scene`` for the scene of a :class:`PoseScene`.

    ``built`` is the folder of ``benchmarks.scenes.build``, and ``folder`` is for a scene file that has to be written.
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
    walk = {"positions": eyes.round(3).tolist(), "targets": targets.round(3).tolist()}
    description["path"] = {"kind": "walk", **walk, "duration": 4.0}
    (target / "scene.json").write_text(json.dumps(description), "utf8")
    return str((target / "scene.json").resolve())
