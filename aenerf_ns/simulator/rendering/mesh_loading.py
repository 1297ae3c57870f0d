"""Read meshes with colors and textures from .glb, .obj and .ply files."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import mapbox_earcut
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.limits import file_inside, require_at_most, require_file
from aenerf_ns.simulator.arrays import Array, Texture
from aenerf_ns.simulator.options import MESH_SUFFIXES
from aenerf_ns.simulator.rendering.mesh import DIFFUSE, Gloss, Mesh

# A ray caster takes no larger meshes.
_MAX_BYTES = 1 << 30
_UNCOLORED = 0.5
"""Albedo of a surface that has no color in its file."""
_REMEDY = "export the mesh again"
# Numbers of glTF: of types, and of a fan of triangles.
_UINT16, _FLOAT32, _FAN = 5123, 5126, 6


def load_mesh(path: Path, y_up: bool, gloss: Mapping[str, Gloss] | None = None) -> Mesh:
    """Read a mesh with all the parts and transforms of its scene.

    Of a material, only the base color is read: a factor, a texture, and colors of vertices or faces. Vertex colors of
    .ply and .obj files are sRGB. Factors and the vertex colors of .glb files are linear.

    Args:
        path: a .glb, .obj (with its .mtl) or .ply file.
        y_up: whether the file's y axis points up, in place of z. Vertices are then turned by (x, y, z) -> (x, -z, y).
        gloss: coats of materials, by the names of the materials. The others are diffuse.

    Raises:
        DataError: the file, or a file that it refers to, is missing or cannot be read, or it has no surface, or no
            material of a name in ``gloss``.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise DataError(path, f"unknown kind of mesh {path.suffix!r}", f"give one of {', '.join(MESH_SUFFIXES)}")
    content = _read(path)
    try:
        # Infinite vertices are refused once the whole mesh is known.
        with np.errstate(invalid="ignore", over="ignore"):
            return _build_mesh(path, content, y_up, gloss or {})
    except DataError:
        raise
    except Exception as error:  # a malformed file raises exceptions of any kind in trimesh
        remedy = f"{_REMEDY}, as triangles" if path.suffix.lower() == ".ply" else _REMEDY
        raise DataError(path, f"cannot be read ({error})", remedy) from error


def _read(path: Path) -> bytes:
    require_file(path, "put it there, or correct its name")
    with reading(path):
        require_at_most(path, _MAX_BYTES)
        return path.read_bytes()


class _FilesBeside(trimesh.resolvers.FilePathResolver):
    """The materials and textures beside a mesh. trimesh goes on without a file that is missing, so errors are kept.

    Args:
        path: the mesh.
        library: name of the material file of an .obj, or None. All other files of an .obj or .ply are textures.
    """

    def __init__(self, path: Path, library: str | None) -> None:
        super().__init__(str(path))
        self._path, self._library = path, library
        self.materials: set[str] = set()
        self.errors: list[DataError] = []

    def get(self, name: str) -> bytes:
        try:
            return self._read(name.strip())
        except DataError as error:
            self.errors.append(error)
            raise

    def _read(self, name: str) -> bytes:
        if name.startswith("-"):
            raise DataError(self._path, f"options of a texture ({name})", "apply them in the picture")
        file = file_inside(self._path.parent, name, self._path)
        content = _read(file)
        if name == self._library:
            content = self._read_materials(file, content.decode("utf-8-sig", errors="replace")).encode()
        elif self._path.suffix.lower() != ".glb":
            try:
                Image.open(BytesIO(content)).close()
            except OSError as error:
                raise DataError(file, f"not a picture ({error})", "give a PNG or JPEG file") from error
        return content

    def _read_materials(self, path: Path, text: str) -> str:
        """Return the lines of a material file that are used.

        trimesh drops a color with a comment, and all materials because of another line that it does not expect.
        """
        lines = []
        for line in text.splitlines():
            key, _, value = line.strip().replace("\t", " ").partition(" ")
            key, value = key.lower(), value.strip()
            if key == "newmtl":
                self.materials.add(value)
            elif key == "kd":
                try:
                    numbers = [float(number) for number in value.partition("#")[0].split()]
                except ValueError:
                    numbers = []
                if len(numbers) not in (1, 3):
                    raise DataError(path, f"the color {value!r}", "write three numbers, as in Kd 0.5 0.5 0.5")
                red, green, blue = numbers * (3 // len(numbers))
                value = f"{red!r} {green!r} {blue!r}"
            if key in ("newmtl", "kd", "map_kd"):
                lines.append(f"{key} {value}")
        return "\n".join(lines)


def _read_obj(path: Path, content: bytes) -> tuple[bytes, str | None, set[str]]:
    """Return an .obj file that trimesh reads as it is meant, its material file, and the materials that it uses."""
    text = content.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\\\n", " ")
    # trimesh passes over lines that begin with a blank, or have tabs.
    # It takes words in comments for commands.
    text = re.sub(r"^ *#.*|^ +", "", text.replace("\t", " "), flags=re.MULTILINE)
    libraries = [name.strip() for name in re.findall(r"^mtllib(.*)", text, re.MULTILINE)]
    used = {name.strip() for name in re.findall(r"^usemtl(.*)", text, re.MULTILINE)}
    if len(libraries) > 1:
        raise DataError(path, f"{len(libraries)} material files", "join them into one")
    # trimesh takes a comment behind a face for a corner.
    text = re.sub(r"^(f [^#\n]*)#.*", r"\1", text, flags=re.MULTILINE)
    text = _count_from_beginning(text)
    if wrong := re.search(r"^f (?:.* )?(-\d+|0+\b)", text, re.MULTILINE):
        raise DataError(path, f"a face has the vertex {wrong[1]}, but the first one is 1", _REMEDY)
    painted = re.findall(r"^v(?: +\S+){3}((?: +[-+.\deE]+){3})", text, re.MULTILINE)
    if painted and np.array(" ".join(painted).split(), np.float64).max() > 1:
        raise DataError(path, "vertex colors above 1", "divide them by 255")
    content = _triangulate_obj(_with_texture_coordinates(text)).encode()
    return content, libraries[0] if libraries else None, used


def _build_mesh(path: Path, content: bytes, y_up: bool, gloss: Mapping[str, Gloss]) -> Mesh:
    """Build the mesh in the content of a file."""
    suffix = path.suffix.lower()
    library: str | None = None
    used: set[str] = set()
    if suffix == ".glb":
        _require_plain_glb(path, content)
    elif suffix == ".obj":
        content, library, used = _read_obj(path, content)
    files = _FilesBeside(path, library)
    if suffix == ".ply":
        header = content.partition(b"end_header")[0].decode("utf-8", errors="replace")
        pictures = re.findall(r"^comment +TextureFile +(.*)", header, re.MULTILINE | re.IGNORECASE)
        if len(pictures) > 1:
            raise DataError(path, f"{len(pictures)} textures", "join them into one, or export the mesh as .glb")
        if re.search(r"^property +u?(?:short|int16) +red\b", header, re.MULTILINE):
            raise DataError(path, "colors of 16 bits", "export them with 8 bits")
        # trimesh would print where a picture that is missing is asked for.
        for picture in pictures:
            files.get(picture)
    scene = trimesh.load_scene(BytesIO(content), file_type=suffix[1:], resolver=files, process=False)
    if files.errors:
        raise files.errors[0]
    if library is not None and used - files.materials:
        raise DataError(path, f"no material {min(used - files.materials)!r}", "add it to the material file")
    # trimesh makes a part of each material of an .obj file, in reversed order.
    nodes = list(scene.graph.nodes_geometry)[:: -1 if suffix == ".obj" else 1]
    placed = [(scene.geometry[name], transform) for transform, name in (scene.graph[node] for node in nodes)]
    placed = [(mesh, transform) for mesh, transform in placed if len(getattr(mesh, "faces", ()))]
    if not placed:
        raise DataError(path, "there is no surface in it", "give a mesh of triangles, not points or lines")
    if suffix == ".ply":
        for mesh, _ in placed:
            _require_plain_ply(path, mesh)
    names = [getattr(getattr(mesh.visual, "material", None), "name", None) or "" for mesh, _ in placed]
    for name in gloss:
        if name not in names:
            known = ", ".join(sorted({*names} - {""})) or "no names of materials"
            raise DataError(path, f"no surface has the material {name!r}", f"the file has {known}")
    textures: dict[int, Texture] = {}
    parts = [_build_part(path, mesh, transform, suffix == ".glb", textures) for mesh, transform in placed]
    vertices, faces, uv, color, texture = zip(*parts, strict=True)
    world, joined = trimesh.util.append_faces(vertices, faces)
    if y_up:
        world = np.stack([world[:, 0], -world[:, 2], world[:, 1]], axis=1)
    if not np.isfinite(world[joined]).all():
        raise DataError(path, "vertices that are not finite", _REMEDY)
    return Mesh(
        world,
        joined.astype(np.int64),
        np.concatenate(uv),
        np.concatenate(color),
        np.concatenate(texture),
        np.zeros(len(joined)),
        np.repeat([gloss.get(name, DIFFUSE) for name in names], [len(part) for part in faces], axis=0),
        tuple(textures.values()),
    )


def _build_part(
    path: Path, mesh: Any, transform: Array, is_gltf: bool, textures: dict[int, Texture]
) -> tuple[Array, NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Return vertices, faces, texture coordinates, colors, and the texture of each face. Add new textures."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if faces.max() >= len(vertices) or faces.min() < 0:
        raise DataError(path, "a face has a vertex that does not exist", _REMEDY)
    visual = mesh.visual
    if visual.kind == "face":
        if len(visual.face_colors) != len(faces):
            raise DataError(path, "polygons with a color each", "export it as triangles")
        # Face colors need separate vertices for each face.
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    uv, index, color = np.zeros((len(vertices), 2)), -1, np.full((len(vertices), 3), _UNCOLORED)
    if visual.kind == "face":
        color = np.repeat(_linear_colors(visual.face_colors, is_gltf), 3, axis=0)
    elif visual.kind == "vertex":
        color = _linear_colors(visual.vertex_colors, is_gltf)
    elif visual.kind == "texture":
        # trimesh keeps the colors of a .glb with its materials, and those of an .obj with its vertices.
        painted = visual.vertex_attributes.get("color", mesh.vertex_attributes.get("color"))
        is_painted = painted is not None and len(painted) == len(vertices)
        factor, image = _base_color(visual.material, is_painted)
        color = np.tile(factor, (len(vertices), 1))
        if is_painted:
            color = color * _linear_colors(painted, is_gltf)
        if image is not None and visual.uv is not None and len(visual.uv) == len(vertices):
            uv = np.asarray(visual.uv, np.float64)[:, :2]
            if not np.isfinite(uv).all():
                raise DataError(path, "texture coordinates that are not finite", _REMEDY)
            if id(image) not in textures:
                # PIL clips the values of deeper pictures to 8 bits.
                if image.mode.startswith(("I", "F")):
                    remedy = "store the textures with 8 bits"
                    raise DataError(path, f"a texture of more than 8 bits (PIL's mode {image.mode})", remedy)
                linear = decode(np.arange(256) / 255, "srgb").astype(np.float32)
                textures[id(image)] = linear[np.asarray(image.convert("RGB"))[::-1]]
            index = list(textures).index(id(image))
    moved = vertices @ transform[:3, :3].T + transform[:3, 3]
    if np.linalg.det(transform[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return moved, faces, uv, color, np.full(len(faces), index)


def _base_color(material: Any, is_painted: bool) -> tuple[Array, Any]:
    """Return the linear color factor (3,) and the picture, or None, of a material.

    Without either, the factor is that of an uncolored surface, or 1 where vertices have colors (``is_painted``).
    """
    if hasattr(material, "baseColorTexture"):
        factor = material.baseColorFactor
        return (np.ones(3) if factor is None else np.asarray(factor)[:3] / 255.0), material.baseColorTexture
    # trimesh rounds `diffuse` to 8 bits, but keeps the file's own value in `kwargs`.
    image, factor = material.image, (material.kwargs or {}).get("kd")
    if image is not None and image.format is None:
        # It comes from no file: trimesh paints surfaces without a material in a gray of its own.
        image = None
    if factor is not None and np.size(factor) == 3:
        return np.asarray(factor, np.float64), image
    return np.full(3, 1.0 if is_painted or image is not None else _UNCOLORED), image


def _linear_colors(values: Any, is_linear: bool) -> Array:
    """Return linear RGB (N, 3) of colors that are integers of any width, or decimals."""
    colors = np.asarray(values)[:, :3]
    if colors.dtype.kind in "iu":
        colors = colors / float(np.iinfo(colors.dtype).max)
    return decode(np.asarray(colors, np.float64).clip(0, None), "linear" if is_linear else "srgb")


def _require_plain_glb(path: Path, content: bytes) -> None:
    """Raise a DataError for content that trimesh would ignore, or take for something else, without a word."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sIII4s", content)
        header = json.loads(content[20 : 20 + length])
        if magic != b"glTF" or kind != b"JSON":
            raise ValueError("no glTF 2.0 header")
        required = [name for name in header.get("extensionsRequired", []) if not name.startswith("KHR_materials")]
        parts = [part for mesh in header.get("meshes", []) for part in mesh["primitives"]]
        # Of each part: what is read of its values, by name. What moves a mesh is often sparse, and is not read.
        read = [
            {name: header["accessors"][index] for name, index in part["attributes"].items()}
            | ({"indices": header["accessors"][part["indices"]]} if "indices" in part else {})
            for part in parts
        ]
        colors = [
            of["COLOR_0"] for of, part in zip(read, parts, strict=True) if "COLOR_0" in of and "material" not in part
        ]
        mapped = [of["TEXCOORD_0"] for of in read if "TEXCOORD_0" in of]
        materials = [material.get("pbrMetallicRoughness", {}) for material in header.get("materials", [])]
        textures = [material.get("baseColorTexture", {}) for material in materials]
        moves = [texture.get("extensions", {}).get("KHR_texture_transform", {}) for texture in textures]
        faults = [
            (required, f"needs {', '.join(required)}", "export the mesh without extensions or compression"),
            (
                any(values["componentType"] == _UINT16 for values in colors),
                "colors of 16 bits on a surface without a material",
                "give it one, or colors of 8 bits",
            ),
            (
                any("source" not in texture for texture in header.get("textures", [])),
                "textures of an unknown kind",
                "export the mesh with PNG or JPEG textures",
            ),
            (
                any(values["componentType"] != _FLOAT32 for values in mapped),
                "texture coordinates that are integers",
                "export them as decimals",
            ),
            (any(texture.get("texCoord") for texture in textures), "a second set of texture coordinates", "keep one"),
            (
                # The values that move nothing.
                any(value not in (0, [0, 0], [1, 1]) for move in moves for value in move.values()),
                "a texture that is moved or scaled on its surface",
                "bake it, or change the texture coordinates",
            ),
            (any(part.get("mode") == _FAN for part in parts), "fans of triangles", "export the mesh as triangles"),
            (any("sparse" in values for of in read for values in of.values()), "sparse values", _REMEDY),
        ]
    except (struct.error, LookupError, ValueError, AttributeError, TypeError) as error:
        raise DataError(path, f"not a binary glTF file ({error})", "export the mesh as .glb") from error
    for is_found, problem, remedy in faults:
        if is_found:
            raise DataError(path, problem, remedy)


def triangulate(corners: Array) -> NDArray[np.int64]:
    """Cut a simple polygon with corners (N, 3) into triangles that keep its orientation.

    Returns:
        Corner numbers (T, 3). T is at most N - 2: earcut may leave out corners that repeat a neighbor or lie on a line
        with both, and parts of polygons that cross themselves.
    """
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)  # Newell's
    axis = int(np.argmax(np.abs(normal)))
    flat = corners[:, [(axis + 1) % 3, (axis + 2) % 3]] * [1.0, np.sign(normal[axis]) or 1.0]
    triangles = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    return triangles.reshape(-1, 3).astype(np.int64)


def _least_turns(corners: Array) -> Array:
    """Return the least turn (P,) at a corner of each of P polygons (P, N, 3), negative where they are concave.

    A turn is the sine of its angle, times the adjacent sides, times twice the polygon's area.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    turns = np.cross(edges, np.roll(edges, -1, axis=1))
    normals = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1, keepdims=True)
    return (turns * normals).sum(axis=-1).min(axis=1)


def _require_plain_ply(path: Path, mesh: Any) -> None:
    """Raise a DataError if a .ply has concave polygons, or decimal colors above 1.

    trimesh makes fans of polygons, which fill convex ones alone, and clips the colors.
    """
    elements = mesh.metadata["_ply_raw"]
    corner = elements["vertex"]["data"]
    colors = [corner[name] for name in ("red", "green", "blue") if name in elements["vertex"]["properties"]]
    if any(column.dtype.kind == "f" and column.max() > 1 for column in colors):
        raise DataError(path, "vertex colors above 1", "divide them by 255")
    points = np.column_stack([corner[axis] for axis in "xyz"]).astype(np.float64)
    columns = elements["face"]["data"]
    names = [*(columns.dtype.names if isinstance(columns, np.ndarray) else columns)]
    polygons = columns[next((name for name in names if name in ("vertex_index", "vertex_indices")), names[0])]
    # Of a binary file, the corners follow their number. Of a text file, polygons of several lengths are objects.
    rows = polygons["f1"] if polygons.dtype.names else polygons
    lengths = np.array([len(row) for row in rows]) if rows.ndim == 1 else np.full(len(rows), rows.shape[1])
    for length in np.unique(lengths[lengths > 3]):
        corners = points[np.stack(rows[lengths == length]).astype(np.int64)]
        size = np.ptp(corners, axis=1).max(axis=1)
        # Fans fill what rounding makes concave all but exactly.
        if (_least_turns(corners) < -1e-4 * size**4).any():
            raise DataError(path, "concave polygons", "export it as triangles, or as .obj")


def _count_from_beginning(text: str) -> str:
    """Return the text of an .obj file whose faces count back from their own line with positive numbers instead.

    trimesh counts them back from the end of the file.
    """
    if not re.search(r"^f .*-", text, re.MULTILINE):
        return text
    lines = text.split("\n")
    counts = {"v": 0, "vt": 0, "vn": 0}
    for number, line in enumerate(lines):
        key, *names = line.split() or [""]
        if key in counts:
            counts[key] += 1
        elif key == "f":
            corners = (zip(name.split("/"), counts.values(), strict=False) for name in names)
            lines[number] = "f " + " ".join(
                "/".join(str(count + 1 + int(index)) if index.startswith("-") else index for index, count in corner)
                for corner in corners
            )
    return "\n".join(lines)


def _with_texture_coordinates(text: str) -> str:
    """Return the text of an .obj file where faces without texture coordinates have (0, 0) if others have some.

    trimesh drops the texture of a material if one of its faces has no coordinates.
    """
    bare = re.compile(r"^f +\d+(?: |//).*", re.MULTILINE)
    if not bare.search(text) or not re.search(r"^f +\d+/\d", text, re.MULTILINE):
        return text
    last = len(re.findall(r"^vt ", text, re.MULTILINE)) + 1
    text = bare.sub(lambda line: re.sub(r" (\d+)\S*", rf" \1/{last}", line[0]), text)
    return f"{text}\nvt 0 0\n"


def _triangulate_obj(text: str) -> str:
    """Return the text of an .obj file with its concave polygons cut into triangles. trimesh fills all by a fan."""
    if not re.search(r"^f(?: +\S+){4}", text, re.MULTILINE):
        return text
    lines = text.split("\n")
    positions = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], np.float64)
    polygons: dict[int, list[tuple[int, list[str]]]] = {}
    for number, line in enumerate(lines):
        if line.startswith("f ") and len(names := line.split()[1:]) > 3:
            polygons.setdefault(len(names), []).append((number, names))
    for rows in polygons.values():
        corners = positions[[[int(name.partition("/")[0]) - 1 for name in names] for _, names in rows]]
        for i in np.flatnonzero(_least_turns(corners) < 0):
            number, names = rows[i]
            triangles = (" ".join(names[k] for k in triangle) for triangle in triangulate(corners[i]))
            lines[number] = "\n".join(f"f {triangle}" for triangle in triangles)
    return "\n".join(lines)
