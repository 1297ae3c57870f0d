"""Weights files of E2VID and FireNet, which the user has."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch

from aenerf_ns.errors import DataError, reading
from aenerf_ns.reconstruction.networks import E2VID, FireNet, ReconstructionNetwork

NetworkName = Literal["e2vid", "firenet"]

_NETWORKS: dict[NetworkName, type[ReconstructionNetwork]] = {"e2vid": E2VID, "firenet": FireNet}

# Where the authors' own pages lead to. The weights are not this project's to distribute.
_WHERE = {
    "e2vid": "download E2VID_lightweight.pth.tar, which https://github.com/uzh-rpg/rpg_e2vid links to",
    "firenet": "download firenet_1000.pth.tar, which https://github.com/cedric-scheerlinck/rpg_e2vid links to, on its "
    "branch cedric/firenet",
}


def load_network(name: NetworkName, weights: Path | None) -> ReconstructionNetwork:
    """Return a network with the weights of a file, ready for inference on the CPU.

    Nothing in the file is executed. Every parameter of the network must be in it, and no other.

    Args:
        name: of the network.
        weights: a file of ``torch.save``: a dictionary with ``state_dict``.

    Raises:
        DataError: there is no such file, it cannot be read without executing it, or it is of another network.
    """
    remedy = f"{_WHERE[name]}, and give it with --weights"
    if weights is None:
        raise DataError(f"--method {name}", "no weights are given", remedy)
    with reading(weights):
        if not weights.is_file():
            raise DataError(weights, "there is no such file", remedy)
    try:
        content = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as error:
        # torch.load raises errors of many kinds, with advice to trust the file.
        raise DataError(weights, f"not a file of plain weights ({type(error).__name__})", remedy) from None
    if not isinstance(content, dict) or not isinstance(content.get("state_dict"), dict):
        raise DataError(weights, "it holds no state_dict", remedy)
    network = _NETWORKS[name]()
    try:
        network.load_state_dict(content["state_dict"], strict=True)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines()]
        raise DataError(weights, f"its weights are not {name}'s ({' '.join(lines)})", remedy) from None
    return network.eval()
