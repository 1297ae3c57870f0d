"""Weights files of E2VID and FireNet, which the user has."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from aenerf_ns.errors import DataError, require_file

if TYPE_CHECKING:
    from aenerf_ns.reconstruction.networks import E2VID, FireNet

# Where the authors' own pages lead to. The weights are not this project's to distribute.
_REMEDY = (
    "download firenet_1000.pth.tar, which https://github.com/cedric-scheerlinck/rpg_e2vid links to, on its branch "
    "cedric/firenet, or E2VID_lightweight.pth.tar, which https://github.com/uzh-rpg/rpg_e2vid links to"
)


def require_weights(weights: Path) -> None:
    """Raise a DataError if there is no such weights file."""
    require_file(weights, _REMEDY)


def load_network(weights: Path) -> E2VID | FireNet:
    """Load a network with the weights of a file, ready for inference on the CPU.

    Nothing in the file is executed. Every parameter of the network must be in it, and no other. The names of the
    parameters tell which network it is.

    Args:
        weights: a file of ``torch.save``: a dictionary with ``state_dict``.

    Raises:
        DataError: there is no such file, it cannot be read without executing it, or it is of neither network.
    """
    # The import takes seconds, and commands look for the file before them.
    import torch

    from aenerf_ns.reconstruction.networks import E2VID, FireNet

    require_weights(weights)
    try:
        with warnings.catch_warnings():
            # torch warns of the kind of pickle before it raises the error.
            warnings.simplefilter("ignore")
            content = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as error:
        # torch.load raises errors of many kinds, with advice to trust the file.
        raise DataError(weights, f"not a file of plain weights ({type(error).__name__})", _REMEDY) from None
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise DataError(weights, "it holds no state_dict", _REMEDY)
    name = next(iter(state), "").partition(".")[0]
    network = E2VID() if name == E2VID.name_in_file else FireNet()
    try:
        torch.nn.ModuleDict({network.name_in_file: network}).load_state_dict(state, strict=True)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines()]
        problem = f"its weights are not those of {type(network).__name__} ({' '.join(lines)})"
        raise DataError(weights, problem, _REMEDY) from None
    return network.eval()
