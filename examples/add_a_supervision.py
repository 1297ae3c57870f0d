"""Train with a supervision of your own: `python add_a_supervision.py DATA OUTPUT [STEPS]`.

The events say by how much the log-radiance of a pixel changed between two moments. AE-NeRF squares the difference to
the rendered change; this supervision takes its absolute value. The pairs, the field, the poses and the evaluation stay
as they are. To give such a method a name for ns-train, register it with the entry point nerfstudio.method_configs.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerfstudio.scripts.train import main as train
from torch import Tensor

from aenerf_ns.method_configs.aenerf import aenerf_small
from aenerf_ns.supervision.event_pairs import PairBatch, PairSupervision, PairSupervisionConfig


@dataclass
class AbsoluteErrorConfig(PairSupervisionConfig):
    """Compares changes by their absolute difference."""

    _target: type = field(default_factory=lambda: AbsoluteError)


class AbsoluteError(PairSupervision):
    """Compares the rendered change of a pair with the events' by the absolute difference, in thresholds."""

    def losses(self, outputs: Mapping[str, Any], batch: PairBatch) -> dict[str, Tensor]:
        """Return the loss of a batch."""
        predicted, change = self.changes(outputs, batch)
        return {"reconstruction_loss": (batch.weight * ((predicted - change) / self.loss_unit(outputs)).abs()).mean()}


def main(data: Path, output: Path, steps: int = 2000) -> None:
    """Train for some steps without a viewer."""
    config = deepcopy(aenerf_small.config)
    config.method_name = "absolute-error"
    config.pipeline.model.supervision = AbsoluteErrorConfig()
    # Changes of silent pixels are known up to a threshold only, which this loss does not handle.
    config.pipeline.datamanager.sampler.silent_pair_share = 0.0
    config.data, config.output_dir, config.max_num_iterations, config.vis = data, output, steps, "tensorboard"
    train(config)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
