"""Check whether the poses fit the events: by the contrast of warped events, and the depth at which it is highest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.checking.contrast import WarpedEvents, contrast_of
from aenerf_ns.checking.hypotheses import STILL
from aenerf_ns.checking.result import CheckResult
from aenerf_ns.recording.recording import Recording

# Share of what is seen that is in the scene box.
_MIN_IN_BOX_SHARE = 0.5
# Contrast above that of the shuffled events by these standard deviations and by this factor is not noise.
_NOISE_DEVIATIONS, _NOISE_FACTOR = 4.0, 1.5
# One slice alone gives no verdict.
_MIN_SLICES = 2
# Nor do two or three about the clock: of the many offsets that are tried, one fits a hand's shaking by chance.
_MIN_CLOCK_SLICES = 4
# Share of the slices that, each by itself, must clearly fit another meaning of the poses for it to be named.
_MIN_SHARE_IN_FAVOR = 0.5
# Share of the slices that clearly fit another meaning of the poses, and not all the same one. With the poses of another
# path it is about half.
_MAX_ELSEWHERE_SHARE = 0.3
# Scene units to what is seen, or their inverse: poses in millimeters, or a short path that was scaled to one unit.
_MAX_DISTANCE = 50
# The depth of a tile with less than this share of the mean contrast is not trusted.
_MIN_TILE_CONTRAST = 0.5


def check_contrast(result: CheckResult, warped: WarpedEvents, is_simple: bool) -> bool | None:
    """Compare the given poses with the alternatives and with shuffled events, and return whether the poses fit.

    Too few events do not tell: None.

    ``is_simple`` says that a simpler problem was found, which may be the reason of all that this finds.
    """
    figures, problems = result.figures, result.problems
    still = warped.compare(STILL)
    if still is None:
        problems.append("the lens gives no direction to the pixels of nearly all events: check its distortion")
        return False
    alternatives, shuffled = warped.compare_alternatives(), warped.shuffled_contrasts()
    mean, deviation = float(shuffled.mean()), float(shuffled.std())
    num_slices, seconds = len(warped.spans), np.median([end - start for start, end in warped.spans]) * 1e-9
    figures.append(
        f"Contrast of events warped by the poses (slices: {num_slices} of {seconds:.3f} s): {still.given:.3f}; "
        f"not warped: {still.contrast:.3f}; shuffled: {mean:.3f} +/- {deviation:.3f}"
    )
    for c in alternatives:
        if not c.hypothesis.is_of_series or c.is_clearly_better:
            figures.append(f"  {c.contrast:.3f} (given {c.given:.3f}) if {c.hypothesis.name}")
    clocks = [c.hypothesis.clock_offset for c in alternatives if c.hypothesis.clock_offset and c.is_clearly_worse]
    if clocks:
        figures.append(f"  clearly less if the clock of the poses is off by {min(map(abs, clocks)) * 1e-9:g} s")
    noise = max(mean + _NOISE_DEVIATIONS * deviation, _NOISE_FACTOR * mean)
    if is_simple or num_slices < _MIN_SLICES:
        reason = "what is wrong above" if is_simple else "too few events"
        figures.append(f"Because of {reason}, the contrast does not tell whether poses, lens and clock are right.")
        return False if is_simple else None
    better = [
        c
        for c in alternatives
        if c.is_clearly_better
        and c.contrast > noise
        and len(c.slices_in_favor)
        >= max(_MIN_CLOCK_SLICES if c.hypothesis.clock_offset else _MIN_SLICES, _MIN_SHARE_IN_FAVOR * num_slices)
    ]
    if better:
        best = better[0]
        same = [c for c in better[1:] if best.is_like(c) and not c.hypothesis.is_of_series]
        others = "".join(f"; or as if {c.hypothesis.name}: {c.hypothesis.remedy}" for c in same)
        problems.append(
            f"the events look as if {best.hypothesis.name} (contrast {best.contrast:.3f} instead of {best.given:.3f}, "
            f"clearly in {len(best.slices_in_favor)} of {num_slices} slices). First make sure of the lens and the size "
            f"of the sensor. If that may be, {best.hypothesis.remedy}{others}"
        )
        return False
    undecided = [c.hypothesis for c in alternatives if c.is_inconclusive and not c.hypothesis.clock_offset]
    inconclusive = [hypothesis.name for hypothesis in undecided if not hypothesis.is_of_series]
    factors = sorted(hypothesis.focal_factor for hypothesis in undecided if hypothesis.is_of_series)
    if factors:
        inconclusive.append(f"the focal lengths are {' or '.join(map('{:g}'.format, factors))} times the given ones")
    if inconclusive:
        figures.append(f"This motion cannot tell whether {', or '.join(inconclusive)}.")
    in_favor_of_others = frozenset[int]().union(*(c.slices_in_favor for c in alternatives))
    if not still.is_clearly_worse:
        problems.append(
            "the poses do not sharpen the events, nor does any usual mistake explain it: check the intrinsics and the "
            "clock; or the camera moves too little to tell"
        )
    elif still.given <= noise:
        problems.append(
            f"the events are hardly sharper than the same events in a random order (contrast {still.given:.3f}, "
            f"shuffled {mean:.3f} +/- {deviation:.3f}): they are noise, or the poses are of another recording: check "
            "the polarities, the order of the columns and the poses"
        )
    elif len(in_favor_of_others) > max(_MAX_ELSEWHERE_SHARE * num_slices, _MIN_CLOCK_SLICES - 1):
        problems.append(
            f"{len(in_favor_of_others)} of {num_slices} slices of the events clearly fit another meaning of the poses, "
            "and not all the same one: the poses are of another recording, or wrong in places"
        )
    else:
        return True
    return False


def check_depth(result: CheckResult, warped: WarpedEvents, recording: Recording, scale: float) -> None:
    """Describe how far away the scene is, and check that the scene box holds it."""
    names = "energy", "brightness", "depth", "points"
    energy, brightness, depth, point = (np.stack([getattr(part, name) for part in warped.given]) for name in names)
    trusted = (energy > _MIN_TILE_CONTRAST * contrast_of(warped.given) * brightness) & np.isfinite(depth)
    weight, depth, point = energy[trusted], depth[trusted], point[trusted]
    if len(depth) == 0:
        return
    near, median, far = _quantiles(depth, weight, (0.03, 0.5, 0.97))
    low, high = np.array([_quantiles(column, weight, (0.03, 0.97)) for column in point.T]).T
    result.figures.append(
        f"What is seen is {near:.3g} to {far:.3g} away, in units of the poses (median {median:.3g}), within "
        f"{low.round(3).tolist()} to {high.round(3).tolist()} of their world"
    )
    box = recording.scene_box
    if box is None:
        result.planes = {
            "pipeline.model.near-plane": f"{0.7 * near * scale:.2g}",
            "pipeline.model.far-plane": f"{10 * far * scale:.2g}",
        }
        result.figures.append(f"Scene units: {scale:.3g} times those of the poses")
        if not 1 / _MAX_DISTANCE < median * scale < _MAX_DISTANCE and len(warped.given) >= _MIN_SLICES:
            result.problems.append(
                f"what is seen is {median * scale:.2g} scene units away, where training resolves little: give the "
                f"format --auto-scale-poses False --scale-factor {1 / median:.1g}, which brings it to about 1, and let "
                "the check tell the planes for that (--format-options auto-scale-poses=False scale-factor=...)"
            )
    else:
        inside = ((point >= box[0].numpy()) & (point <= box[1].numpy())).all(1)
        share = weight[inside].sum() / weight.sum()
        result.figures.append(f"Within the scene box: {share:.1%} of it")
        if share < _MIN_IN_BOX_SHARE and len(warped.given) >= _MIN_SLICES:
            result.problems.append(
                f"the scene box holds only {share:.1%} of what is seen: state a larger scene_box, or none"
            )


def _quantiles(values: NDArray[np.float64], weights: NDArray[np.float64], shares: tuple[float, ...]) -> list[float]:
    """Return the value below which each share of the weight lies."""
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    return [float(values[order][np.searchsorted(cumulated, share * cumulated[-1])]) for share in shares]
