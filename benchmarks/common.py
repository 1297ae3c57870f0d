"""Run commands, measure in a separate process and write results, for all benchmarks."""

from __future__ import annotations

import functools
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch

from aenerf_ns.training.provenance import provenance
from benchmarks.owned import owned

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def script(name: str) -> str:
    """Return the path of a console script of this Python environment, such as ``ns-train``."""
    return str(Path(sys.executable).parent / name)


def run_script(folder: Path, name: str, *arguments: str) -> float:
    """Run a console script of this Python environment.

    Args:
        folder: working directory of the script.
        name: of the script.
        arguments: of the script.

    Returns:
        Seconds of wall-clock time.

    Raises:
        SystemExit: the script failed; with the end of what it printed.
    """
    begin = time.perf_counter()
    done = subprocess.run(
        owned([script(name), *arguments]),
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{name} {' '.join(arguments)} ended with status {done.returncode}:\n{done.stdout[-3000:]}")
    return time.perf_counter() - begin


def train(folder: Path, name: str, method: str, steps: int, options: Sequence[str], data: Sequence[str]) -> float:
    """Train with ns-train, on a GPU where there is one.

    Args:
        folder: working directory; the run lands in ``outputs/NAME`` there.
        name: of the experiment.
        method: registered method.
        steps: number of training steps.
        options: more options of ns-train.
        data: the last arguments, which name the dataset and, where needed, its format.

    Returns:
        Seconds of wall-clock time.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return run_script(
        folder, "ns-train", method, "--machine.device-type", device, "--vis", "tensorboard",
        "--experiment-name", name, "--max-num-iterations", str(steps), *options, *data,
    )  # fmt: skip


def config_of(folder: Path, name: str) -> str:
    """Return the path of a run's config.yml, relative to the folder that :func:`train` worked in."""
    return str(next((folder / "outputs" / name).rglob("config.yml")).relative_to(folder))


def evaluate(folder: Path, name: str, *options: str) -> dict[str, Any]:
    """Evaluate a run of :func:`train` with ns-eval and return its results."""
    run_script(folder, "ns-eval", "--load-config", config_of(folder, name), "--output-path", f"{name}.json", *options)
    return json.loads((folder / f"{name}.json").read_text("utf8"))["results"]


def in_own_process(
    function: Callable[_Arguments, _Result], *arguments: _Arguments.args, **options: _Arguments.kwargs
) -> _Result:
    """Call a function in a new Python process and return its result.

    The peak memory of the process is then that of the call and of the imports. It also counts the memory that this
    process held when it started the other: keep large arrays out of the caller.
    """
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments, **options).result()


def peak_mib() -> float:
    """Return the peak resident memory of this process in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def write_result(output: Path, result: dict[str, Any], show: bool = True) -> None:
    """Write a result with its machine, versions, commit and command as JSON, and print the result unless not shown."""
    output.write_text(json.dumps({**result, **_provenance()}, indent=2) + "\n", "utf8")
    if show:
        print(json.dumps(result, indent=2), flush=True)


# Looked up once: a result that was just written into the checkout would count as a change to the commit.
_provenance = functools.cache(provenance)
