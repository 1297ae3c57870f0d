"""Fetch, verify and open the packages that the benchmark scenes are made of."""

from __future__ import annotations

import base64
import hashlib
import os
import subprocess
import tarfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.errors import DataError
from aenerf_ns.simulator import textures
from benchmarks.runs import exclusive
from benchmarks.scenes.meshes import Material, Model, paint, srgb_picture
from benchmarks.scenes.obj import read_obj

# OpenCV reads OpenEXR files only if this is set before its import.
os.environ["OPENCV_IO_ENABLE_OPENEXR"] = "1"
import cv2

_PICTURE_SIZE = 512
_DETAILS = {"plain": textures.mottled, "wood": textures.wood, "cloth": textures.fabric}
_LICENSE = "CC0 1.0"


@dataclass(frozen=True)
class Package:
    """A file of a package registry: its name, its pinned hash, and the client's command that saves it here."""

    file: str
    sha256: str
    command: tuple[str, ...]


FURNITURE = Package(
    "sweethome3d-furniture_1.8-1_all.deb",
    "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668",
    ("apt-get", "download", "sweethome3d-furniture=1.8-1"),
)
ENVIRONMENTS = Package(
    "pmndrs-assets-1.7.0.tgz",
    "152bd218a3390703f184f0c6ce16e73c8f0a87f32d38530d418a09d33d8208dc",
    ("npm", "pack", "--silent", "@pmndrs/assets@1.7.0"),
)
_FURNITURE_FILE = "usr/share/sweethome3d/furniture/BlendSwap-CC-0.sh3f"
_CATALOG = "PluginFurnitureCatalog.properties"


def fetch(package: Package, folder: Path) -> Path:
    """Return the path of a package's file in a folder; fetch the file if it is not there.

    Raises:
        DataError: the file cannot be fetched or is not the pinned version.
    """
    by_hand = f"run `{' '.join(package.command)}` where it works and put {package.file} into {folder}"

    def make(empty: Path) -> Path:
        _run(package.command, empty, folder / package.file, by_hand)
        if not (empty / package.file).is_file():
            raise DataError(folder / package.file, f"{package.command[0]} saved it under another name", by_hand)
        return empty / package.file

    file = _make_once(folder / package.file, make)
    found = hashlib.sha256(file.read_bytes()).hexdigest()
    if found != package.sha256:
        raise DataError(file, f"sha256 {found}, not the pinned {package.sha256}", f"remove it, then {by_hand}")
    return file


def _run(command: Sequence[str], folder: Path, file: Path, remedy: str) -> None:
    """Run a command of a registry's client or its packages that makes a file or unpacks it."""
    try:
        subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise DataError(file, f"there is no {command[0]}, which it needs", remedy) from error
    except subprocess.CalledProcessError as error:
        said = " ".join((error.stderr or error.stdout or "no message").split())[-300:]
        raise DataError(file, f"{command[0]} failed: {said}", remedy) from error


def _make_once(path: Path, make: Callable[[Path], Path]) -> Path:
    """Return a file or folder. If it is missing, ``make`` makes it in an empty folder and returns where."""
    if not path.exists():
        # Another process that builds scenes may be making it, too.
        with exclusive(path):
            if not path.exists():
                with TemporaryDirectory(dir=path.parent) as empty:
                    make(Path(empty)).rename(path)
    return path


class Library:
    """Hold the models and environments of the packages in a folder. Fetch and unpack a package at its first use."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.credits: dict[str, dict[str, str]] = {}
        """Entries of a scene file's "credits", by asset, for all assets that were used."""

    def _credit(self, name: str, asset: str, source: str, author: str) -> None:
        self.credits[name] = {"asset": asset, "source": source, "author": author, "license": _LICENSE}

    @cache  # noqa: B019 a library lives as long as the command
    def _furniture(self) -> Path:
        """Unpack the CC0 furniture and return its folder."""
        package = fetch(FURNITURE, self.folder)
        return _make_once(self.folder / package.stem, lambda empty: _unpack(package, empty))

    @cache  # noqa: B019
    def _catalog(self) -> dict[str, dict[str, str]]:
        """Read the entries of the furniture's catalog, by model name."""
        entries: dict[str, dict[str, str]] = {}
        for line in (self._furniture() / _CATALOG).read_text(encoding="latin-1").splitlines():
            key, _, value = line.partition("=")
            name, _, number = key.partition("#")
            if name and number:
                entries.setdefault(number, {})[name] = value
        return {Path(entry["model"]).parent.name: entry for entry in entries.values()}

    def model(self, name: str, detail: str = "plain", dress: Mapping[str, Material] | None = None) -> Model:
        """Return a piece of furniture at its true size. It stands on z = 0 above the origin, its front towards -y.

        Args:
            name: folder of the model in its package.
            detail: pattern of the materials without a picture: "plain", "wood" or "cloth".
            dress: replacements of materials, by the replaced name.

        Raises:
            DataError: the model's own license is not CC0: a few models of the package's CC0 file are CC BY.
        """
        entry = self._catalog()[name]
        path = self._furniture() / entry["model"].lstrip("/")
        for license_file in path.parent.glob("*[Ll][Ii][Cc][Ee][Nn]*"):
            if "Creative Commons Zero" not in license_file.read_text(errors="replace"):
                raise DataError(license_file, f"{name} is not under {_LICENSE}", "use another model")

        def surface(material: str, color: tuple[float, float, float], picture: Path | None) -> Material:
            if dress and material in dress:
                return dress[material]
            if picture is not None:
                return _photograph(f"{name}/{picture.name}", picture)
            return colored(f"{name}/{material}", color, detail)

        centimeters = [float(entry[key]) for key in ("width", "depth", "height")]
        model = read_obj(path, surface, np.array(centimeters) / 100)
        self._credit(name, name, f"{FURNITURE.file}: BlendSwap-CC-0.sh3f", entry.get("creator", "unknown"))
        return model.standing()

    def environment(self, name: str) -> NDArray[np.float32]:
        """Return the linear RGB radiance (256, 512, 3) of an equirectangular environment, its first row straight up."""
        package = fetch(ENVIRONMENTS, self.folder)
        with tarfile.open(package) as archive:
            stream = archive.extractfile(f"package/hdri/{name}.exr.js")
            assert stream is not None
            encoded = stream.read().split(b"base64,")[1].rstrip(b"';\n ")
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_UNCHANGED)
        self._credit(name, f"{name} (environment)", f"{package.name}: hdri/{name}.exr.js", "Poly Haven")
        return with_whole_sun(np.ascontiguousarray(picture[..., 2::-1], np.float32))


def _unpack(package: Path, empty: Path) -> Path:
    """Unpack the furniture of a Debian package into an empty folder, and return the folder of the models."""
    _run(
        ("dpkg-deb", "-x", str(package), "."), empty, package, "install Debian's dpkg, and see whether the disk is full"
    )
    with zipfile.ZipFile(empty / _FURNITURE_FILE) as archive:
        archive.extractall(empty / "models")
    return empty / "models"


def with_whole_sun(panorama: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a panorama (H, W, 3) whose sun has all its colors.

    The package's compression lost the red and the green of some suns, and left ringing in their blue. Such suns get the
    color of the sky around them.
    """
    lost = (panorama[..., 0] < 1e-3) & (np.abs(panorama[..., 2]) > 1)
    if not lost.any():
        return panorama
    around = panorama[binary_dilation(lost, iterations=2) & ~lost]
    sky = np.median(around, axis=0)
    whole = panorama.copy()
    whole[lost] = np.maximum(panorama[lost][:, 2:] / sky[2], 1) * sky
    return whole


def colored(name: str, color: tuple[float, float, float], pattern: str = "plain") -> Material:
    """Make a material with a faint pattern around an sRGB color (0 to 1), neither black nor glaring."""
    tones = [np.clip(np.array(color) * factor, 0.2, 0.95) for factor in (0.85, 1.0, 1.15)]
    hexadecimal = ["".join(f"{round(255 * value):02x}" for value in tone) for tone in tones]
    return paint(name, _DETAILS[pattern], hexadecimal, size=128)


@cache
def _photograph(name: str, path: Path) -> Material:
    """Make a material of a picture file: sides are powers of two, albedo is in the range of the other textures."""
    with Image.open(path) as picture:
        sides = [int(min(_PICTURE_SIZE, 2 ** round(np.log2(side)))) for side in picture.size]
        pixels = np.asarray(picture.convert("RGB").resize(sides, Image.Resampling.LANCZOS))
    return Material(name, srgb_picture(np.clip(decode(pixels / 255, "srgb"), *textures.ALBEDO_RANGE)))
