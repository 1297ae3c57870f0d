"""The device that a run asks for."""

from __future__ import annotations

import torch


def require_device(device: str | torch.device) -> None:
    """End the process with one line if a GPU is asked for and there is none.

    Args:
        device: the kind of the device. Nerfstudio gives a torch.device in place of a name when it opens a run.
    """
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise SystemExit(
            "Error: --machine.device-type cuda: no GPU can be used; train on the CPU with: ns-train aenerf-small "
            "--machine.device-type cpu ..., or install a driver that fits the CUDA of PyTorch"
        )
