"""Nerfstudio's nerfacto, where it would not run.

    python -m aenerf_ns.bench.nerfacto ns-train nerfacto ...
    python -m aenerf_ns.bench.nerfacto ns-eval ...

Its constructor builds LPIPS, asked for or not, and dies without a connection: here the metric is left out then. Its
checkpoints hold NumPy's numbers, which current torch refuses to load unless told that they are trusted. And its SSIM
takes for the range of the data that of each picture: here it is 1, or its figures could not stand beside others.
"""

from __future__ import annotations

import importlib
import os
import sys
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

_MODULES = {"ns-train": "nerfstudio.scripts.train", "ns-eval": "nerfstudio.scripts.eval"}


class _Absent(nn.Module):
    def forward(self, *_: Tensor) -> Tensor:
        return torch.tensor(torch.nan)


def prepare() -> None:
    """Changes what this module is for, in this process."""
    import torchmetrics.functional as functional
    import torchmetrics.image.lpip as lpip

    build = lpip.LearnedPerceptualImagePatchSimilarity

    def build_or_leave_out(*arguments: Any, **options: Any) -> nn.Module:
        try:
            return build(*arguments, **options)
        except Exception:
            # torch.hub raises whatever its connection raises.
            return _Absent()

    lpip.LearnedPerceptualImagePatchSimilarity = build_or_leave_out  # type: ignore[misc,assignment]
    functional.structural_similarity_index_measure = partial(
        functional.structural_similarity_index_measure, data_range=1.0
    )
    os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"


def main() -> None:
    """Runs a command of Nerfstudio's."""
    prepare()
    sys.argv = sys.argv[1:]
    importlib.import_module(_MODULES[sys.argv[0]]).entrypoint()


if __name__ == "__main__":
    main()
