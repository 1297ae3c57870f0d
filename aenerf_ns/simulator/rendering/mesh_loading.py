"""Read meshes with colors and textures from .glb, .obj and .ply files."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.errors import DataError, reading, reason
from aenerf_ns.files.limits import require_at_most
from aenerf_ns.simulator.arrays import Array, Texture
from aenerf_ns.simulator.options import MESH_SUFFIXES
from aenerf_ns.simulator.rendering.mesh import DIFFUSE, Gloss, Mesh
from aenerf_ns.simulator.rendering.polygons import triangulated_obj

# Of meshes that a ray caster takes.
_MAX_BYTES = 1 << 30

UNCOLORED = 0.5
"""Albedo of a surface that has no color in its file."""


def load_mesh(path: Path, y_up: bool, gloss: Mapping[str, Gloss] | None = None) -> Mesh:
    """Read a mesh with all the parts and transforms of its scene.

    Of a material, only the base color is read: a factor, a texture, and colors of vertices or faces. Vertex colors
    of .ply and .obj files are sRGB. Factors and the vertex colors of .glb files are linear.

    Args:
        path: a .glb, .obj (with its .mtl) or .ply file.
        y_up: whether the file's y axis points up, in place of z. Vertices are then turned by (x, y, z) -> (x, -z, y).
        gloss: coats of materials, by the names of the materials. The others are diffuse.

    Raises:
        DataError: the file, or a file that it refers to, is missing or cannot be read, or it has no surface, or no
            material of a name in ``gloss``.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise DataError(path, f"unknown kind of mesh {suffix!r}", f"give one of {', '.join(MESH_SUFFIXES)}")
    with reading(path):
        if not path.is_file():
            raise DataError(path, "the file does not exist", "check the name")
        require_at_most(path, _MAX_BYTES)
        content = path.read_bytes()
    try:
        return _mesh(path, content, y_up, gloss or {})
    except DataError:
        raise
    except OSError as error:
        raise DataError(
            error.filename or path, f"cannot be read ({reason(error)})", "check its name and rights"
        ) from None
    except Exception as error:  # a malformed file raises exceptions of any kind in trimesh
        raise DataError(path, f"cannot be read ({error})", "export the mesh again") from error


def _mesh(path: Path, content: bytes, y_up: bool, gloss: Mapping[str, Gloss]) -> Mesh:
    """Return the mesh in the content of a file."""
    import trimesh

    suffix = path.suffix.lower()
    if suffix == ".glb":
        _check_glb(path, content)
    elif suffix == ".obj":
        _check_obj(path, content.decode("utf-8", errors="replace"))
        content = triangulated_obj(content.decode("utf-8", errors="replace")).encode()
    scene = trimesh.load_scene(
        BytesIO(content),
        file_type=suffix[1:],
        resolver=trimesh.resolvers.FilePathResolver(str(path)),
        process=False,
    )
    nodes = list(scene.graph.nodes_geometry)
    # trimesh makes a part of each material of an .obj file, in reversed order.
    placed = [scene.graph[name] for name in (reversed(nodes) if suffix == ".obj" else nodes)]
    meshes = [
        (scene.geometry[name], np.asarray(transform, np.float64))
        for transform, name in placed
        if len(getattr(scene.geometry[name], "faces", ()))
    ]
    if not meshes:
        raise DataError(path, "there is no surface in it", "give a mesh of triangles, not points or lines")
    textures: dict[int, tuple[int, Texture]] = {}
    names = [_material_name(mesh.visual) for mesh, _ in meshes]
    for name in gloss:
        if name not in names:
            known = ", ".join(sorted({known for known in names if known})) or "no names of materials"
            raise DataError(path, f"no surface has the material {name!r}", f"the file has {known}")
    parts = [_part(path, mesh, transform, suffix == ".glb", textures) for mesh, transform in meshes]
    vertices, faces, uv, color, texture = zip(*parts, strict=True)
    first = np.cumsum([0, *map(len, vertices)])
    world = np.concatenate(vertices)
    if y_up:
        world = np.stack([world[:, 0], -world[:, 2], world[:, 1]], axis=1)
    joined = np.concatenate([part + start for part, start in zip(faces, first, strict=False)])
    if not np.isfinite(world[joined]).all():
        raise DataError(path, "vertices that are not finite", "export the mesh again")
    return Mesh(
        world,
        joined,
        np.concatenate(uv),
        np.concatenate(color),
        np.concatenate(texture),
        np.zeros(len(joined)),
        np.repeat([gloss.get(name, DIFFUSE) for name in names], [len(part) for part in faces], axis=0),
        tuple(image for _, image in textures.values()),
    )


def _part(
    path: Path, mesh: Any, transform: Array, is_gltf: bool, textures: dict[int, tuple[int, Texture]]
) -> tuple[Array, NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Return vertices, faces, texture coordinates, colors, and the texture of each face. Add new textures."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if faces.max() >= len(vertices) or faces.min() < 0:
        raise DataError(path, "a face has a vertex that does not exist", "export the mesh again")
    visual = mesh.visual
    uv, index = np.zeros((len(vertices), 2)), -1
    if visual.kind == "face":
        # Face colors need separate vertices for each face.
        vertices, uv = vertices[faces].reshape(-1, 3), np.zeros((3 * len(faces), 2))
        color = np.repeat(_colors(visual.face_colors, is_gltf), 3, axis=0)
        faces = np.arange(3 * len(faces)).reshape(-1, 3)
    elif visual.kind == "vertex":
        color = _colors(visual.vertex_colors, is_gltf)
    elif visual.kind == "texture":
        material = visual.material
        factor, image = _material(material)
        color = np.tile(factor, (len(vertices), 1))
        painted = visual.vertex_attributes.get("color")
        if painted is not None and len(painted) == len(vertices):
            color = color * _colors(painted, is_gltf)
        if image is not None and visual.uv is not None and len(visual.uv) == len(vertices):
            uv = np.asarray(visual.uv, np.float64)[:, :2]
            if not np.isfinite(uv).all():
                raise DataError(path, "texture coordinates that are not finite", "export the mesh again")
            if id(image) not in textures:
                try:
                    pixels = np.asarray(image.convert("RGB"))[::-1]
                except OSError as error:
                    raise DataError(path, f"a texture cannot be read ({error})", "export the mesh again") from error
                table = decode(np.arange(256) / 255, "srgb").astype(np.float32)
                textures[id(image)] = (len(textures), table[pixels])
            index = textures[id(image)][0]
    else:
        color = np.full((len(vertices), 3), UNCOLORED)
    # Infinite vertices are refused later, where the whole mesh is known.
    with np.errstate(invalid="ignore", over="ignore"):
        turned = vertices @ transform[:3, :3].T + transform[:3, 3]
    if np.linalg.det(transform[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return turned, faces, uv, color, np.full(len(faces), index)


def _material_name(visual: Any) -> str:
    """Return the name of a surface's material, or "" if it has none."""
    return getattr(getattr(visual, "material", None), "name", None) or ""


def _material(material: Any) -> tuple[Array, Any]:
    """Return the linear color factor (3,) and the picture, or None, of a material."""
    if hasattr(material, "baseColorTexture"):
        factor = material.baseColorFactor
        return (np.ones(3) if factor is None else np.asarray(factor)[:3] / 255.0), material.baseColorTexture
    # trimesh rounds `diffuse` to 8 bits, but keeps the file's own value in `kwargs`.
    image, factor = material.image, (material.kwargs or {}).get("kd")
    if factor is not None and np.size(factor) == 3:
        return np.asarray(factor, np.float64), image
    return np.full(3, UNCOLORED if image is None else 1.0), image


def _colors(values: Any, is_linear: bool) -> Array:
    """Return linear RGB (N, 3) of colors that are integers of any width, or decimals."""
    colors = np.asarray(values)[:, :3]
    if colors.dtype.kind in "iu":
        colors = colors / float(np.iinfo(colors.dtype).max)
    colors = np.asarray(colors, np.float64).clip(0, None)
    return decode(colors, "linear" if is_linear else "srgb")


def _check_glb(path: Path, content: bytes) -> None:
    """Refuse content that trimesh would ignore without a word."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sIII4s", content)
        header = json.loads(content[20 : 20 + length])
        if magic != b"glTF" or kind != b"JSON" or not isinstance(header, dict):
            raise ValueError("no glTF 2.0 header")
        required = [name for name in header.get("extensionsRequired", []) if not name.startswith("KHR_materials")]
        textures = [texture for texture in header.get("textures", []) if "source" not in texture]
        names = [image.get("uri", "data:") for image in header.get("images", [])]
    except (struct.error, ValueError, AttributeError, TypeError) as error:
        raise DataError(path, f"not a binary glTF file ({error})", "export the mesh as .glb") from error
    if required:
        raise DataError(path, f"needs {', '.join(required)}", "export the mesh without extensions or compression")
    if textures:
        raise DataError(path, "textures of an unknown kind", "export the mesh with PNG or JPEG textures")
    for name in names:
        if not name.startswith("data:") and not (path.parent / name).is_file():
            raise DataError(path.parent / name, f"the texture does not exist, and {path.name} needs it", "add it")


def _check_obj(path: Path, text: str) -> None:
    """Refuse an .obj that refers to a missing file, because trimesh would leave its surfaces gray."""
    from PIL import Image

    libraries = [line.split(None, 1)[1].strip() for line in text.splitlines() if line.startswith("mtllib ")]
    if len(libraries) > 1:
        raise DataError(path, f"{len(libraries)} material files", "join them into one")
    defined: set[str] = set()
    for library in libraries:
        file = path.parent / library
        if not file.is_file():
            raise DataError(file, f"the materials do not exist, and {path.name} needs them", "add the file")
        for line in file.read_text(errors="replace").splitlines():
            key, _, name = line.strip().partition(" ")
            name = name.strip()
            if key == "newmtl":
                defined.add(name)
            elif key.lower() == "map_kd":
                if name.startswith("-"):
                    raise DataError(file, f"options of a texture ({line.strip()!r})", "apply them in the picture")
                texture = path.parent / name
                if not texture.is_file():
                    raise DataError(texture, f"the texture does not exist, and {file.name} needs it", "add the file")
                try:
                    Image.open(texture).close()
                except OSError as error:
                    raise DataError(texture, f"not a picture ({error})", "give a PNG or JPEG file") from error
    used = {line.split(None, 1)[1].strip() for line in text.splitlines() if line.startswith("usemtl ")}
    if libraries and used - defined:
        raise DataError(path.parent / libraries[0], f"no material {min(used - defined)!r}", "add it to the file")
