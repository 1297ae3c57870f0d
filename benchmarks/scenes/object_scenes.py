"""Scenes that the camera goes around: true-sized things on a platform."""

from __future__ import annotations

from aenerf_ns.simulator import textures as tx
from benchmarks.scenes.assets import Library
from benchmarks.scenes.furnishings import bookcase, framed_picture, furnish, oak, podium, steel, walnut
from benchmarks.scenes.meshes import Model, paint
from benchmarks.scenes.shapes import box, disc, revolved


def piano(library: Library) -> Model:
    """Build a mahogany grand piano, its bench with a bear on it, a guitar and an orchid."""
    mahogany = paint("mahogany", tx.wood, ["6e3a24", "8f4f30", "b06b45"])
    cloth = paint("red cloth", tx.fabric, ["8a3b35", "a5544a", "b9695c"])
    boards = paint("parquet", tx.planks, ["8f6a45", "a98258", "c09a6e"], rows=6)
    scene = podium(1.3, 0.12, boards, mahogany)
    scene += library.model("pianoAQueue", "wood", {"black": mahogany}).moved((0, 0.25, 0))
    dress = {"Glossy_Coating": walnut(), "Matte_Coating": walnut(), "Leather": cloth}
    scene += library.model("pianoBench", "wood", dress).moved((0, -0.92, 0))
    scene = scene.with_dropped(library.model("teddyBear"), 0.05, -0.92, 165)
    scene += library.model("electricGuitar").moved((0.85, -0.55, 0), -30)
    return furnish(scene, library, [
        ("stool2", -0.95, -0.35, 0), ("orchids", -0.95, -0.35, 0),
    ])  # fmt: skip


def bookshelf(library: Library) -> Model:
    """Build a bookcase with knick-knacks; a rocking horse and a stool stand before it."""
    boards = paint("pale boards", tx.planks, ["a58d6c", "b9a27f", "cbb793"], rows=6)
    scene = podium(1.15, 0.1, boards, walnut())
    case = bookcase(1.5, 0.34, (0.12, 0.52, 0.9, 1.26, 1.6), oak(), 7, fill=0.72)
    scene += case.moved((0, 0.45, 0))
    landscape = paint("shelf landscape", tx.landscape, ["d9cdb0", "a9bccf"], ["8f9a8a", "6f7f5f", "4f6448"], size=512)
    shapes = paint("shelf shapes", tx.abstract, "d0c6ae", ["b5623f", "4f6f8f", "c9b58f"], size=512)
    for x, canvas in ((-0.36, landscape), (0.36, shapes)):
        scene += framed_picture(0.5, 0.8, canvas, walnut()).moved((x, 0.62, 1.05), 180)
    for name, x, below, turn in (
        ("cactus", 0.62, 0.9, 0), ("cartoon_biplane", 0.62, 1.25, -30), ("woodToy", 0.60, 0.5, 10),
        ("JapaneseLantern", 0.60, 1.6, 0), ("littlePlant", 0.5, 9, 0), ("augalas", -0.4, 9, 180), ("deer", 0.1, 9, 40),
    ):  # fmt: skip
        scene = scene.with_dropped(library.model(name), x, 0.43, turn, below)
    scene += library.model("caballito", "wood").moved((-0.35, -0.35, 0), 25)
    return furnish(scene, library, [
        ("stool2", 0.55, -0.45, 0), ("teddyBear", 0.55, -0.45, -20), ("tennisRacket", -0.35, 0.85, 90),
        ("chicken", 0.3, 0.88, 130), ("basketball", 0.05, -0.8, 0),
    ])  # fmt: skip


def plants(library: Library) -> Model:
    """Build a table with potted plants on it and around it."""
    tiles = paint("terracotta tiles", tx.checker, ["b0795a", "c69a7a"], cells=6)
    scene = podium(1.1, 0.1, tiles, paint("stone", tx.mottled, ["8f8a80", "a39e92", "b5b0a4"], 0.08), 1.0)
    scene += library.model("oakTable").moved((0, 0, 0), scale=0.8)
    return furnish(scene, library, [
        ("augalas", -0.12, 0.18, 60), ("orchids", 0.2, 0.12, 0), ("littlePlant", -0.22, -0.2, 0),
        ("cactus", 0.12, -0.22, 0), ("kalender", 0.33, -0.1, 30),
        ("plant", -0.75, 0.45, 0), ("decorativePlant", 0.72, 0.5, 0), ("plantie", 0.1, -0.85, 5),
        ("rock3", 0.8, -0.4, 40), ("stoneLantern", -0.78, -0.4, 0),
    ])  # fmt: skip


def playground(library: Library) -> Model:
    """Build a climbing hut with a slide, a see-saw and a rocking motorbike on grass."""
    grass = paint("grass", tx.mottled, ["5f7a3a", "74914a", "8ba55f"], 0.12)
    scene = box((-2.9, -3.0, -0.2), (2.9, 3.0, 0), grass, 1.2)
    scene += library.model("childHut", "wood").moved((-0.4, 0.2, 0))
    scene += library.model("seesaw").moved((2.1, 0.6, 0), 80)
    scene += library.model("motorbike").moved((1.9, -2.1, 0), 150)
    scene += library.model("bench").moved((-2.4, 1.4, 0), 90)
    return scene.with_dropped(library.model("basketball"), -1.9, -2.2)


def breakfast(library: Library) -> Model:
    """Build a tray of breakfast."""
    cloth = paint("checked cloth", tx.fabric, ["5c7fa8", "a9bccf", "d5dbdd"])
    china = paint("china", tx.mottled, ["d8d6cf", "e2e0da", "e9e7e1"], 0.03)
    scene = box((-0.46, -0.36, -0.04), (0.46, 0.36, 0), walnut(), 0.3)
    scene += box((-0.42, -0.32, 0), (0.42, 0.32, 0.004), cloth, 0.3, without="z")
    plate = revolved([(0.06, 0), (0.115, 0.014), (0.11, 0.018), (0.06, 0.008)], china, 0.1)
    plate += disc(0.06, 0.008, china, 0.1)
    for x, y in ((-0.24, -0.17), (0.06, -0.19)):
        scene = scene.with_dropped(plate, x, y)
    for name, x, y, turn, scale in (
        ("kitchenaid", 0.27, 0.12, 205, 1.0), ("coffeeBrewer", -0.28, 0.16, 20, 1.0),
        ("hotDog", -0.24, -0.145, 20, 0.8), ("hotDog", -0.24, -0.2, 14, 0.8), ("cupcake", 0.06, -0.15, 0, 1.2),
        ("cupcake", 0.10, -0.215, 40, 1.2), ("cupcake", 0.02, -0.215, 80, 1.2), ("caffe_final", -0.09, -0.03, 30, 1.1),
        ("bread", 0.0, 0.2, 15, 1.0), ("tetrapak", -0.1, 0.24, 160, 0.9), ("butter", 0.28, -0.2, 65, 1.0),
    ):  # fmt: skip
        scene = scene.with_dropped(library.model(name).moved(scale=scale), x, y, turn)
    return scene


def lounge(library: Library) -> Model:
    """Build a leather sofa and an armchair on a rug, with a lamp, a plant and a side table."""
    leather = paint("leather", tx.mottled, ["7d3b2a", "965040", "ab6852"], 0.07)
    rug = paint("rug", tx.rug, ["7a3b35", "4f6480", "c9a66b", "d9cfb8"], size=512)
    boards = paint("dark boards", tx.planks, ["7a5a3c", "8f6c4a", "a5825e"], rows=6)
    scene = box((-1.75, -1.75, -0.12), (1.75, 1.75, 0), boards, 1.0)
    scene += box((-1.2, -1.3, 0), (1.2, 0.7, 0.012), rug, 2.4, without="zZ")
    scene += box((-1.2, -1.3, 0), (1.2, 0.7, 0.012), rug, None, without="xXyYz")
    scene += library.model("sofa2", "wood", {"Fabric": leather, "Trim": leather}).moved((0.1, 1.1, 0))
    scene += library.model("armchair2", "cloth").moved((-0.95, -0.75, 0), 120)
    scene += library.model("oakTable").moved((0.35, -0.35, 0), scale=0.6)
    scene += library.model("bedsideTable2").moved((-1.4, 1.15, 0))
    return furnish(scene, library, [
        ("desklamp", -1.4, 1.15, 0), ("plant", 1.4, -1.2, 0), ("cardGame", 0.3, -0.45, 20),
        ("caffe_final", 0.5, -0.25, 0), ("teddyBear", 0.55, 1.05, -10),
    ])  # fmt: skip


def forklift(library: Library) -> Model:
    """Build a fork-lift truck with a loaded pallet, barrels and crates on concrete."""
    concrete = paint("concrete", tx.mottled, ["85827c", "96938c", "a8a59d"], 0.1)
    hazard = paint("hazard stripes", tx.striped_wallpaper, ["d9b03f", "5a5a5c"])
    scene = box((-2.6, -1.7, -0.15), (2.6, 1.7, 0), concrete, 1.5, without="xXyY")
    scene += box((-2.6, -1.7, -0.15), (2.6, 1.7, 0), hazard, 1.0, without="zZ")
    truck = library.model("forkLift")
    scene += truck.moved((0.5, 0.1, 0))
    scene = furnish(scene, library, [
        ("pallet", -1.85, -0.9, 10), ("crate", -2.1, -0.75, 10), ("crate", -1.65, -1.05, 30),
    ])  # fmt: skip
    scene = scene.with_dropped(library.model("ammoBox").moved(scale=0.8), -1.9, -0.95, 40)
    for x, y in ((1.2, 1.2), (2.05, 1.1), (1.9, -1.1)):
        scene = scene.with_dropped(library.model("barrel"), x, y, 60 * x)
    return furnish(scene, library, [
        ("box", -1.9, 1.1, 15), ("fireExtinguisher", 1.0, -1.3, 0),
    ])  # fmt: skip


def games(library: Library) -> Model:
    """Build a football table with stools and balls."""
    tiles = paint("lino", tx.checker, ["7f97a3", "b5bfc2"], cells=4)
    scene = box((-1.3, -1.3, -0.1), (1.3, 1.3, 0), tiles, 1.0, without="xXyY")
    scene += box((-1.3, -1.3, -0.1), (1.3, 1.3, 0), steel(), 0.5, without="zZ")
    scene += library.model("table_football", "wood").moved((0, 0.05, 0), 15)
    scene = furnish(scene, library, [
        ("silla2", -0.95, -0.85, 20), ("stool2", 0.95, -0.75, 0), ("tableFan", 0.95, -0.75, 30),
        ("caballito", -0.95, 0.95, 30), ("basketball", 0.5, -1.0, 0),
    ])  # fmt: skip
    return scene.with_dropped(library.model("motorbike").moved(scale=0.6), 0.95, 1.0, 200)
