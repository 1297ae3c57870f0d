"""Nerfstudio's nerfacto, where it would not run.

    python -m aenerf_ns.bench.nerfacto ns-train nerfacto ...
    python -m aenerf_ns.bench.nerfacto ns-eval ...

Its constructor builds LPIPS, asked for or not, and dies without a connection: here the metric is left out then. And its
checkpoints hold NumPy's numbers, which current torch refuses to load unless told that they are trusted.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

import torch
from torch import Tensor, nn

_MODULES = {"ns-train": "nerfstudio.scripts.train", "ns-eval": "nerfstudio.scripts.eval"}


class _Absent(nn.Module):
    def forward(self, *_: Tensor) -> Tensor:
        return torch.tensor(torch.nan)


def main() -> None:
    """Runs a command of Nerfstudio's."""
    import torchmetrics.image.lpip as lpip

    build = lpip.LearnedPerceptualImagePatchSimilarity

    def build_or_leave_out(*arguments: Any, **options: Any) -> nn.Module:
        try:
            return build(*arguments, **options)
        except Exception:
            # torch.hub raises whatever its connection raises.
            return _Absent()

    lpip.LearnedPerceptualImagePatchSimilarity = build_or_leave_out  # type: ignore[misc,assignment]
    os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"
    sys.argv = sys.argv[1:]
    importlib.import_module(_MODULES[sys.argv[0]]).entrypoint()


if __name__ == "__main__":
    main()
