"""Meshes from files, and errors in them."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.small_meshes import BLACK, OVERHEAD, painted_box
from PIL import Image

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.errors import DataError
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.rendering.lighting import baked_mesh
from aenerf_ns.simulator.rendering.mesh import Mesh, normals_and_areas, scaled
from aenerf_ns.simulator.rendering.mesh_loading import load_mesh

pytestmark = pytest.mark.usefixtures("small_work")


def seen(path: Path, up: str) -> np.ndarray:
    scene = baked_mesh(scaled(load_mesh(path, up == "y"), 1.0), BLACK)
    pose = paths.look_at((2.0, -1.5, 1.3), (0, 0, 0))
    return scene.render(pose, (60, 60, 32, 24), 64, 48, 1)[0]


def load_obj(folder: Path, text: str, materials: str = "") -> Mesh:
    """Load a mesh of a.obj, beside its materials in a.mtl."""
    (folder / "a.mtl").write_text(materials, encoding="utf-8")
    (folder / "a.obj").write_text(text, encoding="utf-8")
    return load_mesh(folder / "a.obj", False)


MOVED = {"extensions": {"KHR_texture_transform": {"offset": [0, 0], "scale": [2, 2]}}}


@pytest.mark.parametrize(
    ("part", "number", "texture", "problem"),
    [
        ({}, 5123, None, "colors of 16 bits on a surface without a material; give it one"),
        ({"material": 0}, 5123, {}, "texture coordinates that are integers; export them as decimals"),
        ({"material": 0}, 5126, {"texCoord": 1}, "a second set of texture coordinates; keep one"),
        ({"material": 0}, 5126, MOVED, "a texture that is moved or scaled on its surface; bake it"),
        ({"mode": 6}, 5126, None, "fans of triangles; export the mesh as triangles"),
        ({"indices": 2}, 5126, None, "sparse values; export the mesh again"),
    ],
)
def test_refuse_a_glb_that_would_look_different(
    part: dict, number: int, texture: dict | None, problem: str, tmp_path: Path
) -> None:
    header = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1, "TEXCOORD_0": 1}, **part}]}],
        "accessors": [{"componentType": 5126}, {"componentType": number}, {"componentType": 5125, "sparse": {}}],
        "materials": [] if texture is None else [{"pbrMetallicRoughness": {"baseColorTexture": texture}}],
    }
    content = json.dumps(header).encode()
    (tmp_path / "a.glb").write_bytes(
        struct.pack("<4sIII4s", b"glTF", 2, 20 + len(content), len(content), b"JSON") + content
    )
    with pytest.raises(DataError, match=rf"a.glb: {problem}"):
        load_mesh(tmp_path / "a.glb", True)


def test_glb_and_obj_look_alike(tmp_path: Path) -> None:
    z_up = painted_box()
    # As a program with y up would write it: our (x, y, z) is its (x, z, -y).
    y_up = z_up.copy()
    y_up.apply_transform(np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.4, (1, 2, 3), (0.3, 0, 0))
    moved = y_up.copy().apply_transform(np.linalg.inv(turn))
    scene.add_geometry(moved, transform=turn)
    scene.export(tmp_path / "box.glb")
    z_up.visual.material = z_up.visual.material.to_simple()
    z_up.visual.material.kwargs = {"kd": [0.8, 1.0, 0.6]}
    z_up.export(tmp_path / "box.obj", mtl_name="box.mtl")
    text = (tmp_path / "box.mtl").read_text()
    assert "Kd" in text
    (tmp_path / "box.mtl").write_text(
        "\n".join("Kd 0.8 1.0 0.6" if line.startswith("Kd") else line for line in text.splitlines())
    )
    glb, obj = seen(tmp_path / "box.glb", "y"), seen(tmp_path / "box.obj", "z")
    assert (glb > 0).any(-1).mean() > 0.15
    np.testing.assert_allclose(glb, obj, atol=2e-3)
    # At a point of the top, the picture has the texture's value.
    picture = decode(np.random.default_rng(0).integers(40, 220, (12, 16, 3)).astype(np.uint8) / 255, "srgb")[::-1]
    # The center of a texel. The texture's origin is at -0.2 m there.
    pose = OVERHEAD.copy()
    pose[:2, 3] = 3.5 / 16 - 0.2, 2.5 / 12 - 0.2
    scene = baked_mesh(scaled(load_mesh(tmp_path / "box.glb", True), 1.0), BLACK)
    overhead = scene.render(pose, (100.0, 100.0, 0.5, 0.5), 1, 1, 1)[0][0, 0]
    np.testing.assert_allclose(overhead, picture[2, 3] * [0.8, 1.0, 0.6], atol=1e-3)


def test_ply_colors_are_srgb(tmp_path: Path) -> None:
    body = trimesh.creation.box()
    for kind in ("vertex_colors", "face_colors"):
        colors = {kind: np.array([[200, 100, 50, 255]] * (8 if kind[0] == "v" else 12), np.uint8)}
        trimesh.Trimesh(body.vertices, body.faces, process=False, **colors).export(tmp_path / "box.ply")
        mesh = load_mesh(tmp_path / "box.ply", False)
        np.testing.assert_allclose(mesh.color[mesh.faces] / decode(np.array([200, 100, 50]) / 255, "srgb"), 1)


def test_obj_with_concave_polygon(tmp_path: Path) -> None:
    text = (
        "mtllib a.mtl\nv 0 0 0\nv 1 1 0\nv 0 2 0\nv 0.4 1 0\nusemtl red\nf 1 2 \\\r\n3 4 # concave\n"
        "v 2 0 0\nv 3 0 0\nv 3 1 0\nusemtl green\nf -3 -2 -1#flat\n"
    )
    mesh = scaled(load_obj(tmp_path, text, "newmtl red\nKd 0.7 0.1 0.1\n newmtl\tgreen\nKd 0.1 0.6 0.1\n"), 2.0)
    # The notch is not filled; the scale is applied; the first material comes first.
    np.testing.assert_allclose(normals_and_areas(mesh)[1].sum(), 4 * (0.6 + 0.5), rtol=1e-6)
    np.testing.assert_allclose(mesh.color[mesh.faces[0]], [[0.7, 0.1, 0.1]] * 3)
    np.testing.assert_allclose(mesh.color[mesh.faces[-1]], [[0.1, 0.6, 0.1]] * 3)


def test_obj_vertex_colors_beside_a_material(tmp_path: Path) -> None:
    colored = "mtllib a.mtl\nv 0 0 0 1 0.5 0\nv 1 0 0 1 0.5 0\nv 0 1 0 1 0.5 0\nusemtl a\nf 1 2 3\n"
    mesh = load_obj(tmp_path, colored, "newmtl a\nKd 0.5 1 1\n")
    np.testing.assert_allclose(mesh.color[mesh.faces], [[[0.5, float(decode(np.array(0.5), "srgb")), 0]] * 3])


def test_obj_vertex_colors_without_a_color_of_a_material(tmp_path: Path) -> None:
    corners = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nvt 0 0\n"
    for named in ("", "mtllib a.mtl\nusemtl a\n"):
        mesh = load_obj(tmp_path, f"{corners}{named}f 1/1 2/1 3/1\n", "newmtl a\nKs 1 1 1\n")
        np.testing.assert_allclose(mesh.color[mesh.faces], [[[1, 0, 0]] * 3])


def test_colors_of_unusual_material_files(tmp_path: Path) -> None:
    materials = "\ufeffnewmtl a\nKd 0.2 0.3 0.4 # blue\nKs 0.5\nnewmtl b\nKd 0.6\n"
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"
    faces = "f 1/1 2/1 3/1\nusemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 1/1 2/1 3/1\n"
    mesh = load_obj(tmp_path, f"mtllib a.mtl\n{corners}{faces}", materials)
    # A face without a material is as gray as in a file without materials.
    np.testing.assert_allclose(mesh.color[mesh.faces][:, 0], [[0.5] * 3, [0.2, 0.3, 0.4], [0.6] * 3])
    assert mesh.textures == ()


def test_obj_counts_back_from_each_face(tmp_path: Path) -> None:
    part = "v 0 0 {z}\nv 1 0 {z}\nv 0 1 {z}\nvt 0 0\nvt {z} 0\nvt 0 1\nf {face}\n"
    Image.new("RGB", (2, 2)).save(tmp_path / "a.png")
    for corners in ("-3 -2 -1", "-3/-3 -2/-2 -1/-1", "-3/-3/ -2/-2/ -1/-1/"):
        parts = part.format(z=1, face=corners) + part.format(z=2, face=corners)
        mesh = load_obj(tmp_path, f"mtllib a.mtl\nusemtl a\n{parts}", "newmtl a\nmap_Kd a.png\n")
        assert mesh.vertices[mesh.faces].tolist() == [[[0, 0, z], [1, 0, z], [0, 1, z]] for z in (1, 2)]
        if "/" in corners:
            assert mesh.uv[mesh.faces].tolist() == [[[0, 0], [z, 0], [0, 1]] for z in (1, 2)]


def test_obj_keeps_its_texture_beside_a_face_without_coordinates(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2)).save(tmp_path / "a.png")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.2 0.3\nvn 0 0 1\n"
    for bare in ("f  1 3  2", "f 1//1 3//1 2//1"):
        text = f"mtllib a.mtl\n{corners}usemtl a\nf 1/1/1 2/1/1 3/1/1\n{bare}\n"
        mesh = load_obj(tmp_path, text, "newmtl a\nmap_Kd a.png\n")
        assert mesh.texture.tolist() == [0, 0]
        assert mesh.uv[mesh.faces].tolist() == [[[0.2, 0.3]] * 3, [[0, 0]] * 3]
        assert mesh.vertices[mesh.faces[1]].tolist() == [[0, 0, 0], [0, 1, 0], [1, 0, 0]]


def test_obj_with_tabs_leading_zeros_and_a_byte_order_mark(tmp_path: Path) -> None:
    mesh = load_obj(tmp_path, "\ufeffv\t0 0 0\n\tv 2\t0 0\nv\t0 2 0\nf\t01\t02 03\n")
    assert mesh.vertices[mesh.faces].tolist() == [[[0, 0, 0], [2, 0, 0], [0, 2, 0]]]


def test_comments_of_an_obj_say_nothing(tmp_path: Path) -> None:
    text = "# mtllib gone.mtl\nmtllib a.mtl\nv 0 0 0\nv 2 0 0\nv 0 2 0\nusemtl red\nf 1 2 3\n # usemtl green\nf 1 3 2\n"
    mesh = load_obj(tmp_path, text, "newmtl red\nKd 1 0 0\nnewmtl green\nKd 0 1 0\n")
    assert mesh.color[mesh.faces].tolist() == [[[1, 0, 0]] * 3] * 2


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def ply(*faces: str, vertex: str = "", face: str = "") -> str:
    """Write five corners of a concave polygon, and faces, as a .ply. Of other properties all values are 0."""

    def properties(stated: str) -> list[str]:
        kind, *names = stated.split() or [""]
        return [f"property {kind} {name}" for name in names]

    zeros = {key: " 0" * len(properties(key)) for key in (vertex, face)}
    header = ["ply", "format ascii 1.0", "element vertex 5", *(f"property float {axis}" for axis in "xyz")]
    header += [*properties(vertex), f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [*properties(face), "end_header"]
    corners = [f"{corner} 0{zeros[vertex]}" for corner in ("0 0", "2 0", "2 2", "1 0.5", "0 2")]
    return "\n".join([*header, *corners, *(f"{len(row.split())} {row}{zeros[face]}" for row in faces), ""])


def test_convex_polygons_of_a_ply(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ply("0 1 2 4", "0 1 3"))
    mesh = load_mesh(tmp_path / "a.ply", False)
    np.testing.assert_allclose(normals_and_areas(mesh)[1].sum(), 4 + 0.5)


PAINTED = (
    "ply\nformat ascii 1.0\n{}\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "property float s\nproperty float t\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
)
TEXTURED = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"


# A warning of a library would print a second line.
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.json", "{", "not valid JSON"),
        ("a.json", "[]", "expected `object`"),
        ("a.json", "{}", "missing required field `mesh`"),
        ("a.stl", "", "an unknown scene"),
        ("a.glb", "glTF", "not a binary glTF file"),
        ("a.ply", "ply\n", "export the mesh again, as triangles"),
        ("a.ply", ply("0 1 2 3 4"), "concave polygons; export it as triangles"),
        ("a.ply", ply("0 1 2", "0 1 2 3 4"), "concave polygons; export it as triangles"),
        ("a.ply", ply("0 1 2 4", face="uchar red green blue"), "polygons with a color each; export it as triangles"),
        ("a.obj", TRIANGLE.replace("0 0\n", "0 0 255 0 7\n"), "vertex colors above 1; divide them by 255"),
        ("a.ply", ply("0 1 2", vertex="float red green blue").replace("0 0 0\n", "9 0 0\n"), "colors above 1; divide"),
        ("a.ply", ply("0 1 2", vertex="ushort red green blue"), "colors of 16 bits; export them with 8"),
        ("a.ply", PAINTED.format("comment TextureFile gone.png"), "gone.png: there is no such file"),
        ("a.ply", PAINTED.format("comment TextureFile e.png"), "e.png: not a picture"),
        ("a.ply", PAINTED.format("comment TextureFile h.png\ncomment TextureFile e.png"), "2 textures; join them"),
        ("a.obj", TRIANGLE.replace("3\n", "99\n"), "a.obj: "),
        ("a.obj", TRIANGLE.replace("1 2 3", "0 1 2"), "the vertex 0, but the first one is 1"),
        ("a.obj", TRIANGLE.replace("1 2 3", "1/1 2/1 -4/1"), "the vertex 0, but the first one is 1"),
        ("a.obj", TRIANGLE.replace("1 2 3", "-9 2 3"), "the vertex -5, but the first one is 1"),
        ("a.obj", TRIANGLE[:-8], "there is no surface in it"),
        ("a.obj", TRIANGLE.replace("0 1 0", "2 0 0"), "no face has an area"),
        ("a.obj", TRIANGLE.replace("0 1 0", "0 nan 0"), "not finite"),
        ("a.obj", TRIANGLE.replace("v 1", "v inf"), "not finite"),
        ("a.obj", TRIANGLE.replace("v 1", "v inf").replace("1 2 3", "1 2 3 1"), "not finite"),
        ("a.ply", ply("0 1 2 4").replace("2 2 0", "inf 2 0"), "not finite"),
        ("a.obj", TRIANGLE.replace("v ", "v 40000"), "too far from the origin for its size of 1.41; move it"),
        ("a.obj", f"mtllib \n{TRIANGLE}", "a.obj: "),
        ("a.obj", f"mtllib .\n{TRIANGLE}", "a.obj: "),
        ("a.obj", f"mtllib {'m' * 5000}\n{TRIANGLE}", "cannot be read"),
        ("a.obj", f"mtllib b.mtl\n{TRIANGLE}", "b.mtl: there is no such file"),
        ("a.obj", f"mtllib c.mtl\n{TRIANGLE}", "c.png: there is no such file; put it there"),
        ("a.obj", f"mtllib d.mtl\nmtllib d.mtl\n{TRIANGLE}", "2 material files"),
        ("a.obj", f"mtllib d.mtl\nusemtl c\n{TRIANGLE}", "no material 'c'"),
        ("a.obj", f"mtllib d.mtl\nusemtl \n{TRIANGLE}", "no material ''"),
        ("a.obj", f"mtllib e.mtl\nusemtl e\n{TRIANGLE}", "e.png: not a picture"),
        ("a.obj", f"mtllib f.mtl\nusemtl f\n{TRIANGLE}", "options of a texture"),
        ("a.obj", f"mtllib i.mtl\nusemtl i\n{TRIANGLE}", "the color 'xyz 1 1 1'"),
        ("a.obj", f"mtllib h.mtl\nusemtl h\n{TEXTURED}", "a texture of more than 8 bits (PIL's mode I;16)"),
        ("a.obj", f"mtllib g.mtl\nusemtl g\n{TRIANGLE}", "outside the folder"),
    ],
)  # fmt: skip
def test_refuse_mesh(tmp_path: Path, name: str, content: str, problem: str, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "c.mtl").write_text("newmtl c\nmap_Kd c.png\n")
    (tmp_path / "d.mtl").write_text("newmtl d\nKd 1 1 1\n")
    (tmp_path / "e.mtl").write_text("newmtl e\nmap_Kd e.png\n")
    (tmp_path / "e.png").write_text("no")
    (tmp_path / "f.mtl").write_text("newmtl f\nmap_Kd -s 2 2 2 e.png\n")
    (tmp_path / "g.mtl").write_text("newmtl g\nmap_Kd ../e.png\n")
    (tmp_path / "h.mtl").write_text("newmtl h\nmap_Kd h.png\n")
    (tmp_path / "i.mtl").write_text("newmtl i\nKd xyz 1 1 1\n")
    Image.fromarray(np.full((4, 4), 1000, np.uint16)).save(tmp_path / "h.png")
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError) as raised:
        open_scene(str(tmp_path / name))
    assert problem in str(raised.value)
    assert not caplog.records
