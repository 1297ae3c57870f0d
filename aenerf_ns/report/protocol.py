"""How runs are measured, which is known before anything is measured; and which views all runs have."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from aenerf_ns.evaluation.poses import describe_test_poses
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import view_files


@dataclass(frozen=True)
class Protocol:
    """How a run is measured.

    Attributes:
        color_correction: how the colors of the renderings are corrected.
        test_poses: how the test cameras are placed.
        truths: a checksum of each test view's image, by the view's file.
    """

    color_correction: str
    test_poses: str
    truths: dict[str, int]


def read_protocol(run: TrainedRun) -> Protocol:
    """Return how a run will be measured, as it is opened to be tested."""
    truths = {}
    if run.views is not None:
        for index, file in enumerate(view_files(run)):
            truths[file] = zlib.crc32(run.views.get_numpy_image(index).tobytes())
    return Protocol(run.model.color_correction.description, describe_test_poses(run.model.camera_optimizer), truths)


def protocol_differences(names: Sequence[str], protocols: Sequence[Protocol]) -> list[str]:
    """Return in words how runs are measured differently from the first; none if their figures can be compared.

    Args:
        names: of the runs.
        protocols: of the runs.
    """
    found = []
    for name, other in zip(names[1:], protocols[1:], strict=True):
        for what in ("color_correction", "test_poses"):
            ours, theirs = (getattr(protocol, what) for protocol in (protocols[0], other))
            if ours != theirs:
                found.append(f"{what.replace('_', ' ')}: {ours} ({names[0]}), {theirs} ({name})")
        same = shared_views([protocols[0], other])
        if not len(same) == len(protocols[0].truths) == len(other.truths):
            found.append(
                f"test views: {len(protocols[0].truths)} ({names[0]}) and {len(other.truths)} ({name}); both runs have "
                f"{len(same)} images of the same name and content"
            )
    return found


def shared_views(protocols: Sequence[Protocol]) -> list[str]:
    """Return the files of the test views that all runs have, with the same image, in the order of the first run."""
    first, *others = (protocol.truths for protocol in protocols)
    return [file for file, truth in first.items() if all(other.get(file) == truth for other in others)]
