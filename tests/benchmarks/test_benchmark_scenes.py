"""The benchmark's scenes: geometry against truth, what they are composed of, and what a missing asset says."""

import hashlib
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.triangles import area

from aenerf_ns.errors import DataError
from aenerf_ns.simulator.rendering.mesh_loading import load_mesh
from benchmarks.scenes import assets, catalog, furnishings, meshes, object_scenes, place_scenes, shapes
from benchmarks.scenes.build import write_glb
from benchmarks.scenes.cleaning import without_coincident_faces
from benchmarks.scenes.obj import read_obj, triangulate

PLAIN = meshes.Material("plain", np.full((2, 2, 3), 128, np.uint8))


class StandIns:
    """A library whose models are small boxes, and that notes which were asked for."""

    def __init__(self):
        self.names = set()

    def model(self, name, detail="plain", dress=None):
        self.names.add(name)
        return shapes.box((-0.1, -0.1, 0), (0.1, 0.1, 0.2), PLAIN)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("outline", "expected"),
    [
        ([(0, 0), (2, 0), (2, 2), (1, 0.5), (0, 2)], 2.5),  # a notch
        ([(0, 0), (1, 0), (1, 1), (0, 1)], 1.0),
        ([(0, 0), (4, 0), (1, 1), (0, 4)], 4.0),  # a concave quadrilateral
        ([(0, 0), (3, 0), (3, 3), (0, 3), (0, 2), (2, 2), (2, 1), (0, 1)], 7.0),  # a C
    ],
)
@pytest.mark.parametrize("start", [0, 1, 2, 3])
def test_triangulate_polygons(outline, expected, turned, start):
    corners = np.roll(np.array(outline, float), start, axis=0)
    corners = corners[::-1] if turned else corners
    # In a plane that no axis lies in.
    basis = np.linalg.qr(np.array([[1.0, 2, 3], [3, -1, 1], [2, 2, -1]]))[0]
    basis *= np.sign(np.linalg.det(basis))
    polygon = corners @ basis[:2]
    triangles = polygon[triangulate(polygon)]
    assert len(triangles) == len(outline) - 2
    # Without overlap, areas add up to the polygon's only if none lies outside.
    assert area(triangles).sum() == pytest.approx(expected)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (normals @ basis[2] * (-1 if turned else 1) > 0).all()


def test_drop_model():
    table = shapes.box((-1, -1, 0.7), (1, 1, 0.75), PLAIN)
    ceiling = shapes.rectangle((-2, -2, 2.5), (4, 0, 0), (0, 4, 0), PLAIN)
    cup = shapes.box((3, 3, 5), (3.1, 3.1, 5.2), PLAIN)
    scene = table + ceiling
    assert scene.with_dropped(cup, 0.5, 0.5).bounds[1, 2] == pytest.approx(2.7)
    stood = scene.with_dropped(cup, 0.5, 0.5, 30, below=2.0).parts[-6:]
    np.testing.assert_allclose(meshes.Model(stood).bounds.mean(axis=0), [0.5, 0.5, 0.85])
    assert scene.height_under(0.5, 0.5, below=0.72) == pytest.approx(0.7)
    with pytest.raises(ValueError, match="nothing lies under"):
        scene.height_under(1.5, 1.5, below=2.0)


def test_fit_model():
    model = shapes.box((3, 0, 0), (5, 4, 1), PLAIN)
    fitted = model.fitted(1.2, 1.25)
    reach = np.linalg.norm(fitted.triangles, axis=2).max()
    assert reach == pytest.approx(1.25)
    np.testing.assert_allclose(fitted.bounds.sum(axis=0), 0, atol=1e-12)
    assert model.fitted(1.2, 5.0).bounds[1].max() == pytest.approx(1.2)


def test_move_coincident_faces_apart():
    table = shapes.rectangle((-1, -1, 0), (2, 0, 0), (0, 2, 0), PLAIN)
    label = shapes.rectangle((0.1, 0.2, 0), (0.3, 0, 0), (0, 0.3, 0), PLAIN)
    sticker = shapes.rectangle((0.15, 0.25, 0), (0.1, 0, 0), (0, 0.1, 0), PLAIN)
    above = shapes.rectangle((-1, -1, 0.4), (2, 0, 0), (0, 2, 0), PLAIN)
    scene = without_coincident_faces(table + label + sticker + above + above.inside_out(), 1e-3)
    heights = [part.points[..., 2] for part in scene.parts]
    assert [len(height) for height in heights] == [2, 2, 2, 2, 0]
    np.testing.assert_allclose(heights[0], 0)
    np.testing.assert_allclose(heights[3], 0.4)
    assert heights[1].min() == pytest.approx(1e-3)
    assert np.ptp(heights[1]) == pytest.approx(0)
    # What lay on the label must not have been moved into it.
    assert heights[2].min() >= 2e-3 - 1e-9


def test_boxes_face_outwards():
    box = shapes.box((1, 2, 3), (2, 4, 6), PLAIN).triangles
    outward = box.mean(axis=1) - [1.5, 3, 4.5]
    normals = np.cross(box[:, 1] - box[:, 0], box[:, 2] - box[:, 0])
    assert ((normals * outward).sum(axis=1) > 0).all()
    assert area(box).sum() == pytest.approx(2 * (2 + 3 + 6))
    volume = np.linalg.det(shapes.revolved([(0, 0), (1, 0), (1, 2), (0, 2)], PLAIN, sides=256).triangles).sum() / 6
    assert volume == pytest.approx(2 * np.pi, rel=1e-3)


def test_read_obj(tmp_path):
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 100 0 0\nv 100 50 0\nv 0 50 -20\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "usemtl wood\nf 1/1 2/2 3/3\nusemtl glass\nf -4 -2 -1\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl wood\nKd 0.5 0.25 0\nnewmtl glass\nd 0.3\n")
    asked = {}

    def surface(name, color, picture):
        asked[name] = (color, picture)
        return PLAIN

    model = read_obj(tmp_path / "a.obj", surface, size=(2.0, 0.4, 1.0))
    assert asked == {"wood": ((0.5, 0.25, 0), None)}
    np.testing.assert_allclose(model.triangles, [[[0, 0, 0], [2, 0, 0], [2, 0, 1]]])
    (tmp_path / "b.obj").write_text("v 0 0\nf 1 2 x\n")
    with pytest.raises(DataError, match=r"b\.obj"):
        read_obj(tmp_path / "b.obj", surface, (1, 1, 1))


def test_write_glb(tmp_path):
    picture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    model = shapes.box((0, 0, 0), (1, 2, 3), PLAIN) + shapes.rectangle(
        (5, 0, 0), (1, 0, 0), (0, 0, 1), meshes.Material("picture", picture)
    )
    for name in ("a.glb", "b.glb"):
        write_glb(tmp_path / name, model)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    read = trimesh.load_scene(tmp_path / "a.glb", process=False)
    # y is up in the file: (x, y, z) there is (x, -z, y) here.
    np.testing.assert_allclose(read.bounds, [[0, 0, -2], [6, 3, 0]], atol=1e-6)
    last = read.geometry[read.graph["picture"][1]]
    np.testing.assert_array_equal(np.asarray(last.visual.material.baseColorTexture), picture)
    upper = last.vertices[:, 1] > 0.5
    np.testing.assert_allclose(last.visual.uv[upper, 1], 1)  # the reader turns v upwards
    # The order of the triangles is the model's: which of two faces hides the other depends on it.
    corners = load_mesh(tmp_path / "a.glb", y_up=True)
    np.testing.assert_allclose(corners.vertices[corners.faces], model.triangles, atol=1e-6)
    with pytest.raises(ValueError, match="picture"):
        write_glb(
            tmp_path / "c.glb", model + shapes.box((0, 0, 0), (1, 1, 1), meshes.Material("picture", picture[::-1]))
        )


def test_credits_name_every_asset(monkeypatch):
    # Patterns take seconds, and do not matter here.
    for module in (furnishings, object_scenes, place_scenes):
        monkeypatch.setattr(module, "paint", lambda name, *rest, **options: meshes.Material(name, PLAIN.picture))
    credits = Path(catalog.__file__).with_name("CREDITS.md").read_text()
    rows = {line.split("|")[1].strip(): line for line in credits.splitlines() if line.startswith("| ")}
    for name, scene in catalog.SCENES.items():
        library = StandIns()
        assert np.isfinite(scene.compose(library).triangles).all()
        for asset in (*library.names, scene.environment):
            assert name in rows[asset].split("|")[-2].replace(",", " ").split(), (asset, name)


def test_refuse_missing_assets(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))  # no client to fetch with
    library = assets.Library(tmp_path)
    with pytest.raises(DataError, match=r"there is no apt-get.* run `apt-get download .*` .* put .*deb into"):
        library.model("sofa")
    with pytest.raises(DataError, match="there is no npm"):
        library.environment("park")
    (tmp_path / assets.ENVIRONMENTS.file).write_bytes(b"another version")
    with pytest.raises(DataError, match=r"not the pinned .* remove it"):
        library.environment("park")


def test_unpack_furniture_once(tmp_path, monkeypatch):
    archive = tmp_path / "models.sh3f"
    with zipfile.ZipFile(archive, "w") as models:
        models.writestr("PluginFurnitureCatalog.properties", "")
    # Unpacks like dpkg-deb, slowly, and counts how often.
    client = tmp_path / "bin" / "dpkg-deb"
    client.parent.mkdir()
    place = Path(assets._FURNITURE_FILE)
    client.write_text(
        f'#!/bin/sh\necho >> {tmp_path}/calls\n/bin/mkdir -p "$3/{place.parent}"\n/bin/sleep 0.3\n'
        f'/bin/cp {archive} "$3/{place}"\n'
    )
    client.chmod(0o755)
    monkeypatch.setenv("PATH", str(client.parent))
    folder = tmp_path / "assets"
    folder.mkdir()
    package = folder / assets.FURNITURE.file
    package.write_bytes(b"a package")
    pinned = hashlib.sha256(b"a package").hexdigest()
    monkeypatch.setattr(assets, "FURNITURE", replace(assets.FURNITURE, sha256=pinned))
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda library: library._furniture(), [assets.Library(folder), assets.Library(folder)]))
    assert found == [folder / package.stem] * 2
    assert (folder / package.stem / "PluginFurnitureCatalog.properties").is_file()
    assert (tmp_path / "calls").read_text().count("\n") == 1
    # A client that fails leaves nothing that a later build would take for the furniture.
    client.write_text("#!/bin/sh\necho no space left >&2\nexit 2\n")
    other = tmp_path / "other"
    other.mkdir()
    (other / package.name).write_bytes(b"a package")
    with pytest.raises(DataError, match="dpkg-deb failed: no space left"):
        assets.Library(other)._furniture()
    assert [path.name for path in other.iterdir() if not path.name.startswith(".")] == [package.name]


def test_mend_sun_without_colors() -> None:
    sky = np.array([2.0, 1.5, 1.0], np.float32)
    panorama = np.tile(sky, (16, 32, 1))
    whole = assets.with_whole_sun(panorama)
    np.testing.assert_array_equal(whole, panorama)
    # The sun itself, and ringing beside it.
    panorama[5, 7], panorama[5, 8] = (0, 0, 5000), (-1e-6, 0, -800)
    whole = assets.with_whole_sun(panorama)
    np.testing.assert_allclose(whole[5, 7], 5000 * sky)
    np.testing.assert_array_equal(whole[5, 8], sky)
    assert (np.delete(whole.reshape(-1, 3), [5 * 32 + 7, 5 * 32 + 8], axis=0) == sky).all()
