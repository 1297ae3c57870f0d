"""Run Nerfstudio's nerfacto where it would fail, and with metrics that can be compared.

    python benchmarks/paper/nerfacto.py ns-train nerfacto ...
    python benchmarks/paper/nerfacto.py ns-eval ...

Three things differ from Nerfstudio's own commands:

- nerfacto always builds LPIPS, which fails without a connection. The metric is then NaN.
- nerfacto's checkpoints hold NumPy numbers, which recent versions of torch refuse to load unless the file is trusted.
- nerfacto's SSIM takes the range of each picture as the data range. Here the data range is 1, as in all other rows.
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
    """A metric that cannot be computed."""

    def forward(self, *_: Tensor) -> Tensor:
        return torch.tensor(torch.nan)


def prepare() -> None:
    """Change LPIPS, SSIM and the loading of checkpoints, in this process."""
    import torchmetrics.functional as functional
    import torchmetrics.image.lpip as lpip

    build = lpip.LearnedPerceptualImagePatchSimilarity

    def build_or_leave_out(*arguments: Any, **options: Any) -> nn.Module:
        try:
            return build(*arguments, **options)
        except Exception:
            # torch.hub passes on all exceptions of the connection.
            return _Absent()

    lpip.LearnedPerceptualImagePatchSimilarity = build_or_leave_out  # type: ignore[misc,assignment]
    functional.structural_similarity_index_measure = partial(
        functional.structural_similarity_index_measure, data_range=1.0
    )
    os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"


def main() -> None:
    """Run the command of Nerfstudio that the arguments name."""
    prepare()
    sys.argv = sys.argv[1:]
    importlib.import_module(_MODULES[sys.argv[0]]).entrypoint()


if __name__ == "__main__":
    main()
