"""Scenes that the camera walks through. Lengths are in meters, z points up."""

from __future__ import annotations

import numpy as np

from aenerf_ns.simulator import textures as tx
from benchmarks.scenes.assets import Library
from benchmarks.scenes.furnishings import (
    bookcase,
    framed_picture,
    furnish,
    lamp,
    oak,
    room,
    skirting,
    steel,
    wall,
    walnut,
    white_paint,
    window,
)
from benchmarks.scenes.meshes import Material, Model, paint
from benchmarks.scenes.shapes import box, disc, rectangle, revolved


def _canvas(number: int) -> Material:
    """Make a painting, a different one for each number."""
    name = f"painting {number}"
    warm, cool = ["c9b58f", "b5623f", "7a3b35"], ["9fb0b8", "4f6f8f", "35506b"]
    if number % 3 == 0:
        return paint(name, tx.landscape, ["d9cdb0", "a9bccf"], ["8f9a8a", "6f7f5f", "4f6448"], size=512)
    if number % 3 == 1:
        return paint(name, tx.abstract, "d0c6ae", [*warm, *cool], size=512)
    return paint(name, tx.leafy_wallpaper, "b9b49a", ["5f7a5a", "7f8f5a", "a3704f"], size=512)


# A furnished living room


def living_room(library: Library) -> Model:
    """Build sofas around a low table, bookcases, a piano, plants and pictures, with a wide window to the right."""
    low, high, z = (-3.4, -2.7), (3.4, 2.7), 2.7
    sage = paint("sage wallpaper", tx.striped_wallpaper, ["b3b99f", "a5ad92", "bcc1a9"])
    sand = paint("sand plaster", tx.mottled, ["c2b08f", "cbbb9d", "d4c6ab"], 0.05)
    brick = paint("painted bricks", tx.bricks, ["b08a72", "b9967f", "c2a28d"], "bfb3a3")
    leafy = paint("leafy wallpaper", tx.leafy_wallpaper, "b7bba5", ["8f9f82", "9aa58a", "a79a78"])
    boards = paint("oak boards", tx.planks, ["9c7750", "ab875f", "ba9a73"])
    opening = (1.2, 4.2, 0.85, 2.25)
    walls = ((sage, 1.2), (sand, 2.0, [opening], white_paint()), (brick, 1.3), (leafy, 1.4))
    scene = room(low, high, z, walls, (boards, 1.6), (white_paint(), 1.5)) + skirting(low, high, white_paint())
    bars = window(opening[1] - opening[0], opening[3] - opening[2], white_paint(), columns=3)
    scene += bars.moved((high[0] + 0.06, high[1] - opening[0], opening[2]), -90)
    rug = paint("living room rug", tx.rug, ["7a4a40", "5f728a", "c2a574", "cfc5b0"], size=512)
    scene += box((-1.3, -0.95, 0), (1.3, 0.95, 0.012), rug, 2.4, without="zZ")
    scene += box((-1.3, -0.95, 0), (1.3, 0.95, 0.012), rug, None, without="xXyYz")
    case = bookcase(1.7, 0.32, (0.1, 0.46, 0.82, 1.14, 1.44, 1.72), oak(), 11, fill=0.9, columns=2)
    scene += case.moved((-1.7, 2.52, 0))
    for number, x, y, turn, width, height in (
        (0, 0.7, high[1], 0, 1.3, 0.8),
        (1, low[0], -0.2, 90, 0.8, 1.0),
        (4, -1.4, low[1], 180, 0.7, 0.9),
        (2, 0.2, low[1], 180, 1.2, 0.75),
        (3, high[0], -2.1, -90, 0.6, 0.6),
    ):
        picture = framed_picture(width, height, _canvas(number), walnut())
        inwards = np.array([np.sin(np.radians(turn)), -np.cos(np.radians(turn)), 0])
        scene += picture.moved(np.array([x, y, 1.65]) + 0.001 * inwards, turn)
    scene += library.model("cuckooClock").moved((low[0] + 0.1, 1.5, 1.35), 90)
    scene = furnish(scene, library, [
        ("couch", 0.4, -2.2, 180), ("armchair2", -1.9, -1.95, 150), ("sofa2", -2.85, -0.2, 90),
        ("televisionCabinet", 1.0, 2.3, 0), ("pianoAQueue", 2.48, 0.3, -90), ("plant", -2.95, 2.3, 0),
        ("decorativePlant", 2.95, 2.25, 0), ("bedsideTable2", -3.05, -1.65, 90), ("desklamp", -3.05, -1.65, 0),
        ("caballito", -2.2, 1.35, 30), ("electricGuitar", 0.05, 2.4, 0), ("augalas", -1.7, 2.5, 180),
        ("teddyBear", -2.75, 0.2, 90), ("stool2", 2.8, -1.2, 0), ("orchids", 2.8, -1.2, 0),
        ("basketball", -0.6, 2.0, 0),
    ], 2.2)  # fmt: skip
    scene += library.model("oakTable").moved((0, 0, 0.012), scale=0.62)
    return furnish(scene, library, [
        ("cardGame", 0.12, -0.12, 20), ("caffe_final", -0.12, 0.1, 0), ("cactus", 0.0, 0.17, 0),
    ], 2.2)  # fmt: skip


LIVING_ROOM_LAMPS = tuple(lamp(x, y, 2.45, 0.35, (10, 9.2, 8)) for x in (-1.7, 1.7) for y in (-1.0, 1.0))


# A terrace in a garden


def terrace(library: Library) -> Model:
    """Build a paved terrace before a house, with table and umbrella, flowers, rocks, a hut and a row of pot plants."""
    grass = paint("lawn", tx.mottled, ["66803f", "76904c", "87a05c"], 0.1, size=512)
    paving = paint("paving", tx.bricks, ["a39a8a", "aea594", "b9b1a2"], "928a7c", rows=6, columns=3)
    stone = paint("garden wall", tx.bricks, ["9f917c", "ab9d88", "b8ab97"], "9a8f80")
    facade = paint("facade", tx.mottled, ["c9b48e", "d1bf9c", "d8c9aa"], 0.06)
    roof = paint("roof tiles", tx.bricks, ["96543f", "a5654e", "b17560"], "7f4a3a", rows=10, columns=8)
    scene = disc(24, -0.03, grass, 2.2, sides=64)
    scene += box((-5, -4.5, -0.2), (5, 4.5, 0), paving, 1.6, without="z")
    # The house, at the back.
    scene += wall(
        12, 3.2, facade, 2.5, [(1.2, 2.8, 0.9, 2.2), (5.2, 6.8, 0.02, 2.2), (9.2, 10.8, 0.9, 2.2)], white_paint()
    ).moved((-6, 5.6, -0.03))
    dark = paint("dark room", tx.mottled, ["4a4a48", "55544f", "605f5a"], 0.04)
    for x, bottom, height in ((-4.8, 0.9, 1.3), (-0.8, 0.02, 2.18), (3.2, 0.9, 1.3)):
        scene += rectangle((x, 5.75, bottom - 0.03), (1.6, 0, 0), (0, 0, height), dark, 1.0)
        scene += window(1.6, height, white_paint(), 2, 3 if height > 2 else 2).moved((x, 5.66, bottom - 0.03))
    for x in (-6, 6):
        side = wall(4, 3.2, facade, 2.5)
        scene += side.moved((x, 5.6, -0.03), 90) if x > 0 else side.inside_out().moved((x, 5.6, -0.03), 90)
    scene += rectangle((-6.4, 5.2, 3.05), (12.8, 0, 0), (0, 2.6, 1.5), roof, 1.6)
    scene += rectangle((-6.4, 5.2, 2.98), (12.8, 0, 0), (0, 0, 0.07), walnut(), 0.5)
    # Low walls at the sides.
    for low, high in (((-6.3, -5.5, -0.05), (-6.0, 5.6, 0.75)), ((6.0, -5.5, -0.05), (6.3, 5.6, 0.75))):
        scene += box(low, high, stone, 1.2, without="z")
        scene += box((low[0] - 0.04, low[1] - 0.04, 0.75), (high[0] + 0.04, high[1] + 0.04, 0.81), paving, 1.6)
    scene = furnish(scene, library, [
        ("table", 0, 0, 10), ("umbrella", 4.2, 3.1, 0), ("deckChair", 3.2, 2.9, 140), ("deckChair", -3.9, 2.8, 215),
        ("osakaChair", -0.5, -0.85, 190), ("osakaChair", 0.65, 0.85, 15), ("osakaChair", 0.5, -0.75, 170),
        ("chairWithCushion", -0.65, 0.75, -10), ("bench", -4.4, -0.6, 90), ("wheelbarrow", 4.4, -3.6, 150),
        ("stoneLantern", -4.5, -3.6, 0), ("lantern", 4.6, 0.4, 0), ("barrel", 5.4, 4.8, 0), ("rock1", -5.3, -5.2, 0),
        ("rock2", 1.9, -6.0, 60), ("rock3", 2.9, -5.6, 0), ("childHut", -6.0, -11.0, 200),
        ("childSwing", 5.5, -10.5, 30), ("seesaw", 0.5, -9.5, 100), ("fence", -1.1, -4.45, 0),
        ("fence", 0.9, -4.45, 0), ("plantie", 2.5, 4.2, 0), ("flowerBox", -2.2, 4.2, 0), ("flowerBox", -1.5, 4.2, 0),
        ("plant", 1.3, 4.1, 0), ("decorativePlant", -4.6, 4.1, 0), ("decorativePlant", 4.7, -2.2, 0),
        ("plant", -4.6, -2.2, 40), ("littlePlant", -6.15, -3.0, 0), ("littlePlant", -6.15, 0.5, 50),
        ("augalas", 6.15, -0.8, 90), ("littlePlant", 6.15, 2.0, 20), ("mofx_mailbox", 2.6, -4.3, 180),
        ("basketball", 3.2, -2.6, 0), ("chicken", -2.9, -6.2, 60), ("chicken", -2.2, -6.9, 200),
    ], 1.4)  # fmt: skip
    return furnish(scene, library, [
        ("bread", -0.5, 0.05, 40), ("caffe_final", 0.3, 0.2, 0), ("caffe_final", -0.2, -0.25, 90),
        ("tetrapak", 0.3, -0.2, 30), ("cupcake", 0.6, -0.05, 0), ("orchids", -0.05, -0.02, 0),
    ], 1.4)  # fmt: skip


# A gallery


def gallery(library: Library) -> Model:
    """Build a long hall with paintings on its walls, columns, and exhibits on plinths along its middle."""
    low, high, z = (-7.0, -3.2), (7.0, 3.2), 4.0
    plaster = paint("gallery plaster", tx.mottled, ["c4b7a3", "ccc1af", "d3cabb"], 0.05)
    red = paint("gallery red", tx.mottled, ["a5685a", "ad7365", "b57f72"], 0.05)
    marble = paint("marble", tx.mottled, ["b7b2a8", "c4c0b7", "d0ccc4"], 0.05)
    floor_tiles = paint("marble tiles", tx.checker, ["a8a090", "c2bbac"], cells=4)
    doorway = [(2.4, 4.0, 0.0, 2.6)]
    beyond = paint("doorway", tx.mottled, ["6f675c", "7a7267", "857d72"], 0.05)
    walls = 2 * ((plaster, 2.0), (red, 2.0, doorway, walnut()))
    scene = room(low, high, z, walls, (floor_tiles, 2.0), (white_paint(), 1.5)) + skirting(low, high, walnut(), 0.16)
    for x, turn in ((high[0] + 0.15, -90), (low[0] - 0.15, 90)):
        scene += rectangle((-0.9, 0, 0), (1.8, 0, 0), (0, 0, 2.7), beyond, 1.0).moved((x, 0, 0), turn)
    number = 0
    for y, turn in ((high[1], 0), (low[1], 180)):
        for x in (-5.6, -3.2, -0.9, 1.4, 3.6, 5.7):
            width, height = (1.5, 1.0) if number % 2 else (0.9, 1.25)
            picture = framed_picture(width, height, _canvas(number), walnut() if number % 2 else oak(), 0.07)
            scene += picture.moved((x, y - np.cos(np.radians(turn)) * 0.001, 1.7), turn)
            number += 1
    shaft = [(0.34, 0), (0.34, 0.12), (0.24, 0.2), (0.21, z - 0.3), (0.34, z - 0.12), (0.34, z)]
    for x in (-4.4, 0.25, 4.6):
        for y in (-2.75, 2.75):
            scene += revolved(shaft, marble, 0.6).moved((x, y, 0))
    exhibits = (
        ("cartoon_biplane", -5.0, 4.5, 40), ("deer", -3.0, 5.0, 30), ("horse2", -1.0, 0.35, 60),
        ("peterbilt", 1.0, 0.06, 20), ("chicken", 3.0, 1.8, -40), ("cuckooClock", 5.0, 1.0, 80),
    )  # fmt: skip
    for name, x, scale, turn in exhibits:
        scene += box((x - 0.36, -0.36, 0), (x + 0.36, 0.36, 0.12), marble, 0.6, without="z")
        scene += box((x - 0.3, -0.3, 0.12), (x + 0.3, 0.3, 0.85), marble, 0.6, without="zZ")
        scene += box((x - 0.36, -0.36, 0.85), (x + 0.36, 0.36, 0.92), marble, 0.6)
        scene = scene.with_dropped(library.model(name).moved(scale=scale), x, 0, turn, below=1.4)
    return furnish(scene, library, [
        ("decorativePlant", -6.4, 2.6, 0), ("plant", -6.4, -2.6, 0), ("plant", 6.4, 2.6, 0),
        ("decorativePlant", 6.4, -2.6, 0), ("sofa2", -2.1, 2.75, 0), ("sofa2", 2.5, -2.75, 180),
        ("armchair2", 2.9, 2.5, 20), ("couch", -2.1, -2.65, 180),
    ], 1.4)  # fmt: skip


GALLERY_LAMPS = tuple(lamp(x, y, 3.7, 0.4, (14, 13.2, 12)) for x in (-5.4, -1.8, 1.8, 5.4) for y in (-1.3, 1.3))


# A workshop


def workshop(library: Library) -> Model:
    """Build a workshop with a fork-lift truck, crates, barrels, shelves, lockers and a stair, under high windows."""
    low, high, z = (-5.5, -4.5), (5.5, 4.5), 4.2
    brick = paint("workshop bricks", tx.bricks, ["a06a55", "ab7863", "b58875"], "b0a596")
    block = paint("concrete blocks", tx.bricks, ["9a978f", "a3a098", "aba8a1"], "8f8c85", rows=8, columns=4)
    concrete = paint("workshop floor", tx.mottled, ["8a8882", "95938d", "a09e99"], 0.1, size=512)
    panels = paint("roof panels", tx.planks, ["a8a59b", "b2afa6", "bab8b0"], rows=4, columns=1)
    yellow = paint("yellow line", tx.mottled, ["c9a23a", "d3ae4a", "dab85c"], 0.06)
    lights = [(1.0, 4.0, 2.4, 3.5), (5.0, 8.0, 2.4, 3.5)]
    far = (brick, 1.4, [*lights, (9.0, 10.6, 2.4, 3.5)], white_paint())
    walls = (far, (block, 1.8), (brick, 1.4), (block, 1.8, lights, white_paint()))
    scene = room(low, high, z, walls, (concrete, 3.0), (panels, 2.0))
    for x0, x1 in ((1.0, 4.0), (5.0, 8.0), (9.0, 10.6)):
        scene += window(x1 - x0, 1.1, steel(), 3).moved((low[0] + x0, high[1] + 0.06, 2.4))
    for y0 in (1.0, 5.0):
        scene += window(3.0, 1.1, steel(), 3).moved((low[0] - 0.06, low[1] + y0, 2.4), 90)
    # Marked lanes, a hair above the floor.
    lanes = ((-3.1, -2.35, 3.1, -2.25), (-3.1, 2.25, 3.1, 2.35), (-3.1, -2.25, -3.0, 2.25), (3.0, -2.25, 3.1, 2.25))
    for x0, y0, x1, y1 in lanes:
        scene += rectangle((x0, y0, 0.002), (x1 - x0, 0, 0), (0, y1 - y0, 0), yellow, 1.0)
    for x in (-5.2, -1.8, 1.8, 5.2):
        scene += box((x - 0.1, low[1], z - 0.35), (x + 0.1, high[1], z), steel(), 0.8, without="yYZ")
    rack = bookcase(2.4, 0.5, (0.12, 0.7, 1.3, 1.9), steel(), 23, fill=0.55)
    scene += rack.moved((-1.6, -4.2, 0), 180)
    for number, x in ((5, 1.4), (10, 3.2)):
        scene += framed_picture(1.0, 0.8, _canvas(number), steel()).moved((x, low[1] + 0.001, 1.7), 180)
    scene += library.model("emergencySign").moved((high[0] - 0.03, 0.0, 2.5), -90)
    scene = furnish(scene, library, [
        ("forkLift", 3.6, 2.9, 8), ("pallet", -0.2, 0.15, 12), ("pallet", 4.4, -0.6, 80), ("crate", 4.4, -0.95, 5),
        ("crate", 4.4, -0.26, 93), ("barrel", -4.9, 3.95, 0), ("barrel", -4.9, 2.95, 50),
        ("barrel", -4.85, 1.9, 100), ("spiralStaircase", -4.5, -3.5, 0), ("lockedLocker", 0.3, -4.25, 180),
        ("technicalTable1", 2.6, -3.9, 180), ("riggedFan", 3.4, -3.9, 160), ("desklamp", 1.9, -3.95, 0),
        ("kitchenaid", 2.5, -3.9, 150), ("motorbike", -4.5, 0.3, 60), ("wheelbarrow", -4.4, -1.4, 200),
        ("electricGuitar", 1.05, 4.1, 0), ("table_football", -0.9, 3.75, 0), ("plant", 0.35, 4.05, 0),
        ("desk", -3.0, 4.0, 0), ("fireExtinguisher", 5.2, 0.8, -90), ("dustbin", 4.9, -3.9, 0),
        ("box", 4.6, -2.3, 85), ("speaker3", 1.4, 4.1, 0),
    ], 2.2)  # fmt: skip
    return furnish(scene, library, [
        ("crate", -0.55, 0.0, 12), ("crate", 0.2, 0.25, 25), ("ammoBox", 4.5, -2.3, 70),
        ("teddyBear", 0.25, 0.2, 200),
    ], 2.2)  # fmt: skip


WORKSHOP_LAMPS = tuple(lamp(x, y, 3.7, 0.4, (13, 12.6, 12)) for x in (-3.5, 0.0, 3.5) for y in (-2.2, 2.2))
