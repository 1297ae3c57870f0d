"""What is installed: the wheel, what it depends on, the entry points, and the cost of importing the package."""

import email.message
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterable
from importlib.metadata import entry_points, packages_distributions
from pathlib import Path

import pytest
from helpers.source_files import imported_names

import aenerf_ns
from aenerf_ns.dataparsers.formats import FORMATS
from aenerf_ns.training.preflight import provide_ffmpeg

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    # Built by the backend itself, in a process of its own, because there may be no network. The build folder is not in
    # the source tree: the modules that an earlier build left there would be in the wheel too.
    options = folder / "options.cfg"
    options.write_text(f"[build]\nbuild_base = {folder / 'build'}\n", encoding="utf-8")
    build = f"import setuptools.build_meta as backend; backend.build_wheel({str(folder)!r})"
    environment = {**os.environ, "DIST_EXTRA_CONFIG": str(options)}
    subprocess.run([sys.executable, "-c", build], cwd=ROOT, env=environment, check=True, capture_output=True)
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def _sources(*folders: str) -> list[Path]:
    return [path for folder in folders for path in (ROOT / folder).rglob("*.py")]


def test_wheel_holds_the_package_only(wheel: zipfile.ZipFile) -> None:
    names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert {name.split("/")[0] for name in names} == {"aenerf_ns"}
    sources = {path.relative_to(ROOT).as_posix() for path in _sources("aenerf_ns")}
    sources |= {f"aenerf_ns/{path.relative_to(ROOT).as_posix()}" for path in _sources("dataparsers", "method_configs")}
    assert names == sources | {"aenerf_ns/py.typed", "aenerf_ns/report/page.html"}
    assert any(name.endswith("LICENSE") for name in wheel.namelist())


def test_entry_points_exist_in_the_wheel(wheel: zipfile.ZipFile) -> None:
    text = next(wheel.read(name).decode() for name in wheel.namelist() if name.endswith("entry_points.txt"))
    targets = [line.split("=")[1].strip() for line in text.splitlines() if "=" in line]
    assert len(targets) == 25
    for target in targets:
        module, attribute = target.split(":")
        assert attribute in wheel.read(module.replace(".", "/") + ".py").decode()


def _imported(paths: Iterable[Path]) -> set[str]:
    """The distributions that source files import, outside the standard library and this repository."""
    paths = list(paths)
    own = {"aenerf_ns", "benchmarks", "helpers", *(path.stem for path in paths)}
    tops = {name.split(".")[0] for path in paths for name in imported_names(path)}
    tops -= own | set(sys.stdlib_module_names)
    by_module = packages_distributions()
    # Some modules are shared: cv2 by two distributions, backports by any number.
    return {"/".join(sorted({_normal(name) for name in by_module.get(top, [top])})) for top in tops}


def _declared(wheel: zipfile.ZipFile, without_extras: tuple[str, ...] = ()) -> set[str]:
    """The distributions that the wheel asks for, with all extras but some."""
    requirements = _metadata(wheel).get_all("Requires-Dist", [])
    extras = [re.search(r"extra == [\"'](\w[\w-]*)", requirement) for requirement in requirements]
    return {
        _normal(re.split(r"[^\w.-]", requirement)[0])
        for requirement, extra in zip(requirements, extras, strict=True)
        if extra is None or extra[1] not in without_extras
    }


def _metadata(wheel: zipfile.ZipFile) -> email.message.Message:
    return email.message_from_bytes(wheel.read(next(name for name in wheel.namelist() if name.endswith("/METADATA"))))


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_imported_packages_are_declared(wheel: zipfile.ZipFile) -> None:
    package = _sources("aenerf_ns", "dataparsers", "method_configs")
    around = _sources("benchmarks", "scripts", "tests")
    for paths, declared in ((package, _declared(wheel, ("test", "docs", "dev"))), (around, _declared(wheel))):
        undeclared = {imported for imported in _imported(paths) if not set(imported.split("/")) & declared}
        assert not undeclared, f"imported but not in pyproject.toml: {undeclared}"


def test_version_is_stated_alike(wheel: zipfile.ZipFile) -> None:
    version = aenerf_ns.__version__
    assert _metadata(wheel)["Version"] == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {version} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_dataparsers_are_registered() -> None:
    points = entry_points(group="nerfstudio.dataparser_configs")
    assert "event-data" in points.names
    assert all(points[name].load().config is config for name, config in FORMATS.items())


def test_importing_costs_nothing() -> None:
    # Nerfstudio imports it at every command, whatever the method; so it must bring in none of the heavy packages.
    code = "import sys, aenerf_ns; print({'torch', 'numba', 'numpy', 'cv2', 'h5py', 'nerfstudio'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd="/")
    assert done.stdout.strip() == "set()"


def test_the_cache_in_the_temporary_folder_is_the_users_own(tmp_path: Path) -> None:
    code = "import os; os.access = lambda *_: False; import aenerf_ns; print(os.environ['NUMBA_CACHE_DIR'])"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)

    def cache() -> Path:
        done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment)
        return Path(done.stdout.strip())

    own = tmp_path / f"aenerf-ns-numba-{os.getuid()}"
    assert cache() == cache() == own
    # As another user could have made it.
    own.chmod(0o777)
    assert cache() != own


def test_registered_modules_defer_heavy_imports() -> None:
    # What the framework itself imports at every command is no cost of ours.
    code = (
        "import sys, nerfstudio.configs.method_configs as framework, aenerf_ns.files.open;"
        "from nerfstudio.configs.dataparser_configs import all_dataparsers;"
        "assert {'aenerf', 'aenerf-mlp', 'aenerf-small'} <= set(framework.all_methods);"
        "assert 'ecd-data' in all_dataparsers;"
        "print({'numba', 'torchmetrics', 'h5py', 'pycolmap', 'rosbags'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd="/")
    assert done.stdout.strip().splitlines()[-1] == "set()"


def test_missing_ffmpeg_package_breaks_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    provide_ffmpeg()
    assert os.environ["PATH"] == ""


def test_ffmpeg_is_provided(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    provide_ffmpeg()
    done = subprocess.run(["ffmpeg", "-version"], capture_output=True, text=True, check=True, env=dict(os.environ))
    assert "ffmpeg version" in done.stdout
