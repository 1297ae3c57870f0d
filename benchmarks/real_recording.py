r"""Measure how well a field trained on a real recording agrees with the recording's frames, which training never saw.

    ns-train aenerf-small --machine.device-type cpu --vis tensorboard --max-num-iterations 1500 \
        --pipeline.model.near-plane 0.25 --pipeline.model.far-plane 20 --data slider_depth ecd-data
    python -m benchmarks.real_recording --load-config outputs/.../config.yml --output benchmarks/results/NAME.json

Reports, for the trained field and for an untrained one, the correlation of rendered log-radiance with the log-intensity
of each held-out frame at the frame's pose, and the reconstruction loss over many pairs of consecutive events (1 for a
constant field).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from nerfstudio.utils.eval_utils import eval_setup

from aenerf_ns.supervision.event_pairs import PairSamplerConfig
from aenerf_ns.training.pipeline import AENeRFPipeline
from benchmarks.runs import run_benchmark, write_result

_NUM_BATCHES = 20


@dataclass
class RealRecording:
    """Measure the correlation with real frames, and the loss, of a trained run."""

    load_config: Path
    """config.yml of the run."""
    output: Path
    """JSON file to write."""

    def main(self) -> None:
        """Measure and write the figures."""
        config, pipeline, _, step = eval_setup(self.load_config, test_mode="val")
        assert isinstance(pipeline, AENeRFPipeline)
        trained = self._measure(pipeline)
        torch.manual_seed(0)
        fresh = config.pipeline.setup(device=pipeline.device, test_mode="inference").model.state_dict()
        pipeline.model.load_state_dict(fresh)
        result = {
            "recording": pipeline.datamanager.get_datapath().name,
            "method": config.method_name,
            "steps": step + 1,
            "trained": trained,
            "untrained": self._measure(pipeline),
        }
        write_result(self.output, result)

    @torch.no_grad()
    def _measure(self, pipeline: AENeRFPipeline) -> dict:
        model = pipeline.model.eval()
        correlations = {}
        for split in ("val", "test"):
            views = pipeline.datamanager.dataset_type(pipeline.datamanager.dataparser.get_dataparser_outputs(split))
            for index in range(len(views)):
                camera = views.cameras[index : index + 1].to(pipeline.device)
                rendered = model.get_outputs_for_camera(camera)["log_radiance"]
                frame = torch.log(model.reference_radiance(views.get_image_float32(index)) + 1 / 255)
                stacked = torch.stack([rendered.cpu().flatten(), frame.flatten()])
                name = views.image_filenames[index].name
                # A rendering without any structure has no correlation.
                correlations[name] = torch.corrcoef(stacked)[0, 1].nan_to_num().item()
        pipeline.datamanager.config.sampler = PairSamplerConfig(max_events_per_pair=1, silent_pair_share=0.0)
        pipeline.datamanager.supervise(model.supervision)
        torch.manual_seed(1)
        losses = []
        for _ in range(_NUM_BATCHES):
            rays, batch = pipeline.datamanager.next_eval(0)
            losses.append(model.get_loss_dict(model(rays), batch)["reconstruction_loss"].item())
        return {
            "correlation_with_log_frame": correlations,
            "mean_correlation": sum(correlations.values()) / len(correlations),
            "reconstruction_loss": sum(losses) / len(losses),
        }


if __name__ == "__main__":
    run_benchmark(RealRecording)
