"""Cost of a training step without the temporal loss, and with it by several ways to differentiate.

    python benchmarks/step_cost.py --output benchmarks/results/NAME.json

Every variant takes whole steps (sampling a batch, rendering, losses, backward pass, optimizer) of one pipeline at an
equal number of rays, in rounds over all variants, so that what else the machine does meets all alike. A measurement is
two steps, of which one trains the proposal networks. Weights are held still after a short training.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

# A compilation that finds an earlier one's files says nothing about what it costs.
os.environ["TORCHINDUCTOR_FORCE_DISABLE_CACHES"] = "1"

import torch
import tyro
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.field_components.encodings import HashEncoding as FrameworkHashEncoding

import aenerf_ns.method.model
from aenerf_ns.bench.environment import environment
from aenerf_ns.method.encoding.hash_grid import HashEncoding
from aenerf_ns.method.temporal import log_radiance_rate

_WARM_UP = 100
# Seconds to either side; only what it costs counts here.
_DIFFERENCE = 1e-4


@dataclass
class Variant:
    """What of the pipeline is replaced.

    Attributes:
        temporal: whether the temporal loss is on.
        rate: in place of :func:`aenerf_ns.method.temporal.log_radiance_rate`.
        composite: in place of the model's rendering of samples.
        encoding: in place of the hash encoding.
        compiled: whether torch.compile is used.
    """

    temporal: bool
    rate: Callable = log_radiance_rate
    composite: Callable | None = None
    encoding: Callable = HashEncoding.pytorch_fwd
    compiled: bool = False


def moved(samples: RaySamples, rays: tuple, rates: tuple, elapsed: Any) -> RaySamples:
    """Samples on rays that have moved for ``elapsed`` seconds, (N, 1) or a number."""
    origins, directions = (
        (ray + elapsed * rate)[:, None].expand_as(samples.frustums.origins)
        for ray, rate in zip(rays, rates, strict=True)
    )
    return replace(samples, frustums=replace(samples.frustums, origins=origins, directions=directions))


def double_backward(render: Callable, samples: RaySamples, rays: tuple, rates: tuple) -> tuple:
    """The rate by a backward pass that is itself differentiated; for a single channel."""
    elapsed = torch.zeros_like(rays[0][:, :1]).requires_grad_()
    log_radiance, weights = render(moved(samples, rays, rates, elapsed))
    (rate,) = torch.autograd.grad(log_radiance.sum(), elapsed, create_graph=True)
    return log_radiance, rate, weights


def central_differences(render: Callable, samples: RaySamples, rays: tuple, rates: tuple) -> tuple:
    """The rate by two more renderings. Its gradients are wrong on a hash grid."""
    log_radiance, weights = render(samples)
    ahead, behind = (render(moved(samples, rays, rates, step))[0] for step in (_DIFFERENCE, -_DIFFERENCE))
    return log_radiance, (ahead - behind) / (2 * _DIFFERENCE), weights


def compiled(composite: Callable) -> tuple[Callable, Callable]:
    """Rendering and rate through torch.compile. The rate is by torch.func.jvp: what the project ships, make_dual on
    the rays, does not compile."""

    def render(origins, directions, starts, ends, deltas):
        shape = (*starts.shape[:2], 3)
        origins, directions = origins[:, None].expand(shape), directions[:, None].expand(shape)
        return composite(RaySamples(Frustums(origins, directions, starts, ends, starts), deltas=deltas))

    def rate(origins, directions, origin_rates, direction_rates, *distances):
        def at(elapsed):
            return render(origins + elapsed * origin_rates, directions + elapsed * direction_rates, *distances)

        zero = origins.new_zeros(())
        (log_radiance, weights), (rate, _) = torch.func.jvp(at, (zero,), (torch.ones_like(zero),))
        return log_radiance, rate, weights

    fast_render, fast_rate = (torch.compile(function, fullgraph=True, dynamic=False) for function in (render, rate))

    def distances(samples):
        return samples.frustums.starts, samples.frustums.ends, samples.deltas

    def render_samples(samples):
        rays = (value[:, 0].contiguous() for value in (samples.frustums.origins, samples.frustums.directions))
        return fast_render(*rays, *distances(samples))

    def rate_of_samples(_, samples, rays, rates):
        return fast_rate(*(value.contiguous() for value in (*rays, *rates)), *distances(samples))

    return render_samples, rate_of_samples


@dataclass
class StepCost:
    """Measure the cost of a training step."""

    output: Path
    """JSON file to write."""
    simulate: str = "--scene room --speed hard --width 128 --height 96"
    """Options of aenerf simulate, for a monochrome sensor."""
    method: str = "aenerf-small"
    """Registered method."""
    pose_correction: Literal["off", "network", "spline"] = "off"
    """Mode of the pose correction."""
    device: str = "cpu"
    """Where to train."""
    rounds: int = 30
    """Rounds over all variants."""

    def main(self) -> None:
        """Measures and writes the figures."""
        config = all_methods[self.method]
        config.pipeline.model.camera_optimizer.mode = self.pose_correction
        with TemporaryDirectory() as folder:
            data = Path(folder) / "scene"
            command = [Path(sys.executable).parent / "aenerf", "simulate", "--output", data, *self.simulate.split()]
            subprocess.run(command, check=True, capture_output=True)
            config.pipeline.datamanager.dataparser.data = data
            torch.manual_seed(0)
            pipeline = config.pipeline.setup(device=self.device, test_mode="val", world_size=1, local_rank=0)
        self.pipeline = pipeline.to(self.device).train()
        self.optimizers = Optimizers(config.optimizers, pipeline.get_param_groups())
        self.steps = 0
        plain = Variant(temporal=False)
        for _ in range(_WARM_UP):
            self._step(plain)
        for optimizer in self.optimizers.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = 0.0

        render, rate = compiled(pipeline.model._composite)
        framework = FrameworkHashEncoding.pytorch_fwd
        variants = {
            "without": plain,
            "forward_mode": Variant(temporal=True),
            "double_backward": Variant(temporal=True, rate=double_backward),
            "central_differences": Variant(temporal=True, rate=central_differences),
            "without_compiled": Variant(temporal=False, composite=render, compiled=True),
            "forward_mode_compiled": Variant(temporal=True, rate=rate, composite=render, compiled=True),
            "without_framework_encoding": Variant(temporal=False, encoding=framework),
            "forward_mode_framework_encoding": Variant(temporal=True, encoding=framework),
        }
        rows: dict[str, dict] = {}
        for name, variant in variants.items():
            begin = time.perf_counter()
            try:
                rays = self._step(variant)
            except Exception as error:
                rows[name] = {"failed": f"{type(error).__name__}: {error}"[:500]}
                continue
            first = time.perf_counter() - begin
            rows[name] = {"rays": rays} | ({"seconds_of_the_first_step": first} if variant.compiled else {})
        seconds: dict[str, list[float]] = {name: [] for name in rows if "failed" not in rows[name]}
        for _ in range(self.rounds):
            for name, times in seconds.items():
                times.append(self._measure(variants[name]))
        for name, times in seconds.items():
            ratios = [own / without for own, without in zip(times, seconds["without"], strict=True)]
            rows[name] |= {"seconds": _spread(times), "ratio_to_without": _spread(ratios)}
        report = {
            "method": self.method,
            "simulate": self.simulate,
            "pose_correction": self.pose_correction,
            "device": self.device,
            "clock": "CPU time of the process" if self.device == "cpu" else "wall",
            "rounds": self.rounds,
            "variants": rows,
            **environment(),
        }
        print(json.dumps(report, indent=2))
        self.output.write_text(json.dumps(report, indent=2) + "\n")

    def _measure(self, variant: Variant) -> float:
        """Seconds a step, over a step that trains the proposal networks and one that does not."""
        if self.device != "cpu":
            torch.cuda.synchronize()
        # On a CPU shared with other work, the time that the process has had it.
        clock = time.process_time if self.device == "cpu" else time.perf_counter
        begin = clock()
        self._step(variant)
        self._step(variant)
        if self.device != "cpu":
            torch.cuda.synchronize()
        return (clock() - begin) / 2

    def _step(self, variant: Variant) -> int:
        """A training step as the trainer takes it; returns its number of rays."""
        model, sampler = self.pipeline.model, self.pipeline.datamanager.train_pixel_sampler
        coefficients = model.config.loss_coefficients
        model.config.loss_coefficients = {**coefficients, "temporal_loss": 1e-3 if variant.temporal else 0.0}
        sampler.with_time_within = variant.temporal
        HashEncoding.pytorch_fwd = variant.encoding
        aenerf_ns.method.model.log_radiance_rate = variant.rate
        model.__dict__.pop("_composite", None)
        if variant.composite is not None:
            model._composite = variant.composite
        self.optimizers.zero_grad_all()
        outputs, losses, _ = self.pipeline.get_train_loss_dict(self.steps)
        functools.reduce(torch.add, losses.values()).backward()
        self.optimizers.optimizer_step_all()
        model.proposal_sampler.step_cb(self.steps)
        self.steps += 1
        return len(outputs["log_radiance"])


def _spread(values: list[float]) -> dict[str, float]:
    lower, median, upper = statistics.quantiles(values, n=4)
    return {"median": median, "lower_quartile": lower, "upper_quartile": upper}


if __name__ == "__main__":
    tyro.cli(StepCost).main()
