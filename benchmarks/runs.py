"""Run commands, keep what they made, measure in a separate process and write results, for all benchmarks."""

from __future__ import annotations

import functools
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import torch
import tyro
from filelock import FileLock

from aenerf_ns.errors import DataError
from aenerf_ns.training.provenance import provenance

if TYPE_CHECKING:
    from aenerf_ns.training.trainer import AENeRFTrainer

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def script(name: str) -> str:
    """Return the path of a console script of this Python environment, such as ``ns-train``."""
    return str(Path(sys.executable).parent / name)


def die_with_parent(command: Sequence[str]) -> list[str]:
    """Return a command that runs a command and is killed when this process, or its thread that starts it, ends.

    A benchmark that is killed cannot end its commands. They would go on and write where its next start writes. Only
    Linux tells a process that its parent ends; elsewhere the command is returned as it is.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL", "--", *command] if setpriv else list(command)


def run_command(command: Sequence[str], log: Path, folder: Path = Path(), **variables: str) -> float:
    """Run a command in a folder, with more environment variables, and return its seconds of wall-clock time.

    Its output is added to the file ``log``.

    Raises:
        DataError: the command failed.
    """
    begin = time.perf_counter()
    with log.open("a", encoding="utf8") as output:
        output.write(f"$ {shlex.join(command)}\n")
        output.flush()
        with subprocess.Popen(
            die_with_parent(command), cwd=folder, env=os.environ | variables, stdout=output, stderr=subprocess.STDOUT
        ) as process:
            try:
                status = process.wait()
            except BaseException:
                # Otherwise the command would continue beside its successor from the next start.
                process.terminate()
                raise
    if status:
        raise DataError(log, f"a command ended with status {status}", "see the end of this file")
    return time.perf_counter() - begin


@contextmanager
def exclusive(path: Path, timeout: float = -1) -> Iterator[None]:
    """Hold the lock of a file or folder that is being made, which may lie beside others that make it.

    Raises:
        Timeout: another process holds it after ``timeout`` seconds. By default this one waits.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock"), timeout=timeout):
        yield


def make_dataset(
    folder: Path, log: Path, command: str, arguments: Sequence[str], work: Path = Path(), **variables: str
) -> Path:
    """Make a dataset by a command of aenerf, unless it has been made, and return its folder.

    If another process is making it, this one waits. For the other arguments see :func:`run_command`.

    Raises:
        DataError: the command failed.
    """
    with exclusive(folder):
        if not folder.exists():
            words = (script("aenerf"), command, *arguments, "--output", str(folder.resolve()))
            run_command(words, log, work, **variables)
    return folder


def new_trainer(words: Sequence[str], data: Path, output: Path, steps: int, seed: int) -> AENeRFTrainer:
    """Set up a training in this process, on a GPU where there is one, that evaluates and saves nothing on its way.

    Args:
        words: method and options of ns-train.
        data: folder of the dataset.
        output: folder for the run.
        steps: of the training.
        seed: of the training.
    """
    # Imported lazily, because most benchmarks train by the commands.
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.utils import writer

    # Otherwise this training would write into the logs of the one before.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    method, *options = words
    config: Any = tyro.cli(type(all_methods[method]), default=deepcopy(all_methods[method]), args=options)
    config.machine.seed, config.vis = seed, "tensorboard"
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = data
    never = dict.fromkeys(
        ("steps_per_eval_batch", "steps_per_eval_image", "steps_per_eval_all_images", "steps_per_save"), steps + 1
    )
    # A new configuration, because the schedules follow the number of steps when it is made.
    config = replace(config, max_num_iterations=steps, output_dir=output, timestamp="now", **never)
    torch.manual_seed(seed)
    trainer: AENeRFTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


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


# Looked up once, before anything is written: a result in the checkout would count as a change to the commit.
_provenance = functools.cache(provenance)


def run_benchmark(kind: Callable[..., Any]) -> None:
    """Run the command of a benchmark: a dataclass of its options with a method ``main``."""
    command = tyro.cli(kind)
    # Code that is changed while the benchmark runs is not the code that runs.
    _provenance()
    try:
        command.main()
    except DataError as error:
        sys.exit(f"Error: {error}")
