"""Make procedural textures: seeded, tileable, linear albedo within [0.03, 0.92].

A texture is a float32 array (N, N, 3). Columns run along the surface coordinate u. Rows run along v, which points up in
pictures. Colors are sRGB hexadecimal strings "rrggbb".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.simulator.arrays import Array, Texture

ALBEDO_RANGE = (0.03, 0.92)


def linear_color(color: str) -> Array:
    """Return linear RGB (3,) of an sRGB color "rrggbb"."""
    return decode(np.array([int(color[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0, "srgb")


def spectral_noise(
    size: int, rng: np.random.Generator, exponent: float = 1.1, stretch: tuple[float, float] = (1.0, 1.0)
) -> Array:
    """Make tileable noise (N, N) of zero mean and unit deviation, with amplitude 1 / frequency ** exponent.

    ``stretch`` elongates the features along u and along v.
    """
    frequency = np.fft.fftfreq(size) * size
    radius = np.hypot(frequency[None, :] * stretch[0], frequency[:, None] * stretch[1])
    radius[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((size, size))) / np.maximum(radius, 1.0) ** exponent
    spectrum[0, 0] = 0.0
    noise = np.fft.ifft2(spectrum).real
    return noise / noise.std()


def albedo(color: Array, relative_noise: Array) -> Texture:
    """Return the texture of colors (N, N, 3) times the exponential of a noise (N, N), within `ALBEDO_RANGE`."""
    return np.clip(color * np.exp(relative_noise)[..., None], *ALBEDO_RANGE).astype(np.float32)


def mottled(size: int, rng: np.random.Generator, colors: Sequence[str], contrast: float = 0.08) -> Texture:
    """Make clouds that pass through all the colors, under a finer grain: plaster, stone, marble."""
    blend = _blend(colors, 0.5 + 0.24 * spectral_noise(size, rng, 1.5))
    return albedo(blend, contrast * spectral_noise(size, rng, 0.9))


def wood(size: int, rng: np.random.Generator, colors: Sequence[str]) -> Texture:
    """Make wood with its grain along u: warped year rings and stretched fibers."""
    warp = spectral_noise(size, rng, 1.8, (4.0, 1.0))
    rings = np.sin(2 * np.pi * (5 * _coordinate(size)[:, None] + 0.55 * warp))
    fibers = spectral_noise(size, rng, 0.9, (14.0, 1.0))
    return albedo(_blend(colors, 0.5 + 0.22 * rings + 0.10 * fibers), 0.06 * fibers)


def planks(size: int, rng: np.random.Generator, colors: Sequence[str], rows: int = 8, columns: int = 2) -> Texture:
    """Make floorboards along u, each of its own tone, with staggered joints."""
    row, column, edge = _bond(size, rows, columns, rng.random(rows))
    tone = rng.random((rows, columns))[row, column]
    fibers = spectral_noise(size, rng, 0.9, (14.0, 1.0))
    board = _blend(colors, tone + 0.14 * fibers)
    return albedo(board * (0.6 + 0.4 * _smooth_step(edge, 0.002, 0.009))[..., None], 0.06 * fibers)


def bricks(
    size: int, rng: np.random.Generator, colors: Sequence[str], mortar: str, rows: int = 12, columns: int = 4
) -> Texture:
    """Make a running bond of bricks, each of its own tone, with soft mortar joints."""
    row, column, edge = _bond(size, rows, columns, 0.5 * (np.arange(rows) % 2) / columns)
    grain = spectral_noise(size, rng, 0.8)
    brick = _blend(colors, rng.random((rows, columns))[row, column] + 0.12 * grain)
    mix = _smooth_step(edge + 0.0012 * grain, 0.006, 0.014)[..., None]
    return albedo(mix * brick + (1 - mix) * linear_color(mortar), 0.06 * grain)


def striped_wallpaper(size: int, rng: np.random.Generator, colors: Sequence[str], stripes: int = 6) -> Texture:
    """Make upright stripes that cycle through the colors, with diamonds on every other stripe."""
    u, v = _coordinate(size)[None, :] * stripes, _coordinate(size)[:, None] * stripes
    palette = np.array([linear_color(color) for color in colors])
    index = np.floor(u).astype(int) % stripes
    inside = _smooth_step(0.5 - np.abs(u % 1 - 0.5), 0.02, 0.06)
    paper = inside[..., None] * palette[index % len(palette)] + (1 - inside[..., None]) * palette[-1]
    diamond = _smooth_step(0.26 - np.abs(u % 1 - 0.5) - np.abs((v + 0.5 * (index // 2 % 2)) % 1 - 0.5) * 0.7, 0.0, 0.05)
    diamond = (diamond * (index % 2 == 0))[..., None]
    paper = (1 - 0.7 * diamond) * paper + 0.7 * diamond * palette[1 % len(palette)]
    return albedo(paper, 0.05 * spectral_noise(size, rng, 1.0))


def leafy_wallpaper(size: int, rng: np.random.Generator, ground: str, colors: Sequence[str]) -> Texture:
    """Strew leaves of several colors over a mottled ground."""
    paper = np.full((size, size, 3), linear_color(ground))
    u, v = _coordinate(size)[None, :], _coordinate(size)[:, None]
    for _ in range(110):
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.035, 0.075)
        du, dv = (u - rng.random() + 0.5) % 1 - 0.5, (v - rng.random() + 0.5) % 1 - 0.5
        along, across = du * np.cos(angle) + dv * np.sin(angle), dv * np.cos(angle) - du * np.sin(angle)
        width = 0.36 * length * (1 - (along / length) ** 2)
        leaf = _smooth_step(width - np.abs(across), 0.0, 0.006)
        vein = 1 - 0.35 * _smooth_step(0.005 - np.abs(across), 0.0, 0.004)
        color = linear_color(colors[rng.integers(len(colors))]) * rng.uniform(0.8, 1.15)
        paper = paper * (1 - leaf[..., None]) + leaf[..., None] * vein[..., None] * color
    return albedo(paper, 0.06 * spectral_noise(size, rng, 1.1))


def checker(size: int, rng: np.random.Generator, colors: Sequence[str], cells: int = 4) -> Texture:
    """Make soft-edged squares of two colors."""
    wave = np.sin(np.pi * cells * _coordinate(size))
    squares = np.clip(6 * wave[None, :] * wave[:, None], -0.5, 0.5)
    return albedo(_blend(colors, 0.5 + squares), 0.06 * spectral_noise(size, rng, 1.0))


def fabric(size: int, rng: np.random.Generator, colors: Sequence[str]) -> Texture:
    """Make a plain weave with uneven threads and a wide check."""
    coordinate = _coordinate(size)
    wave = np.sin(2 * np.pi * 24 * coordinate)
    check = np.sin(2 * np.pi * 2 * coordinate)
    tone = 0.5 + 0.10 * wave[None, :] * wave[:, None] + 0.16 * (check[None, :] + check[:, None])
    uneven = spectral_noise(size, rng, 0.9, (6.0, 1.0)) + spectral_noise(size, rng, 0.9, (1.0, 6.0))
    return albedo(_blend(colors, tone + 0.08 * uneven), 0.05 * uneven)


def rug(size: int, rng: np.random.Generator, colors: Sequence[str]) -> Texture:
    """Make a rug: borders around a field of nested diamonds. The colors are ground, field, accent and light."""
    ground, field, accent, light = (linear_color(color) for color in colors)
    u, v = np.abs(_coordinate(size) - 0.5)[None, :], np.abs(_coordinate(size) - 0.5)[:, None]
    reach = np.maximum(u, v)
    diamonds = np.sin(2 * np.pi * 6.5 * (u + v)) * np.cos(2 * np.pi * 4 * (u - v))
    picture = field + (accent - field) * _smooth_step(diamonds, 0.1, 0.3)[..., None]
    picture = picture + (light - picture) * _smooth_step(-diamonds, 0.62, 0.8)[..., None]
    teeth = 0.012 * np.abs(((u - v) * 24) % 2 - 1)
    for inner, color in ((0.36, ground), (0.385, light), (0.40, accent), (0.445, light), (0.46, ground)):
        picture = picture + (color - picture) * _smooth_step(reach - inner + teeth, 0.0, 0.006)[..., None]
    pile = spectral_noise(size, rng, 0.5, (3.0, 1.0))
    return albedo(picture, 0.06 * pile)


def book_spine(size: int, rng: np.random.Generator) -> Texture:
    """Make a pale book spine to be tinted, with bands across it and marks in place of a title."""
    v, u = _coordinate(size)[:, None], _coordinate(size)[None, :]
    tone = np.full((size, size), 0.62)
    for height, width in ((0.08, 0.012), (0.12, 0.006), (0.86, 0.012), (0.90, 0.006)):
        tone += 0.28 * _smooth_step(width - np.abs(v - height), -0.006, 0.006)
    letters = _smooth_step(spectral_noise(size, rng, 0.6, (1.0, 5.0)), 0.2, 0.6)
    title = _smooth_step(0.16 - np.abs(v - 0.55), 0.0, 0.01) * _smooth_step(0.22 - np.abs((u * 4) % 1 - 0.5), 0.0, 0.06)
    tone += 0.25 * letters * title
    return albedo(np.repeat(tone[..., None], 3, axis=-1), 0.06 * spectral_noise(size, rng, 1.2))


def landscape(size: int, rng: np.random.Generator, sky: Sequence[str], hills: Sequence[str]) -> Texture:
    """Paint ridges, one before the other, under a clouded sky."""
    v = _coordinate(size)[:, None]
    picture = _blend(sky, 1.5 * v - 0.45 + 0.10 * spectral_noise(size, rng, 1.5, (2.5, 1.0)))
    for depth, color in enumerate(hills):
        profile = spectral_noise(size, rng, 1.9)[0] * 0.05 / (1 + 0.3 * depth)
        ridge = 0.60 - 0.50 * (depth + 0.4) / len(hills) + profile[None, :]
        shade = (0.85 + 0.3 * np.clip((ridge - v) * 3, 0, 1) + 0.12 * spectral_noise(size, rng, 1.0))[..., None]
        mix = _smooth_step(ridge - v, 0.0, 0.006)[..., None]
        picture = (1 - mix) * picture + mix * linear_color(color) * shade
    return albedo(picture, 0.05 * spectral_noise(size, rng, 0.8))


def abstract(size: int, rng: np.random.Generator, ground: str, colors: Sequence[str]) -> Texture:
    """Paint overlapping discs and bars."""
    u, v = _coordinate(size)[None, :], _coordinate(size)[:, None]
    picture = np.full((size, size, 3), linear_color(ground))
    for shape in range(16):
        center, radius, angle = rng.uniform(0.15, 0.85, 2), rng.uniform(0.05, 0.2), rng.uniform(0, np.pi)
        du, dv = u - center[0], v - center[1]
        along, across = du * np.cos(angle) + dv * np.sin(angle), dv * np.cos(angle) - du * np.sin(angle)
        bar = np.maximum(np.abs(along) - 1.5 * radius, np.abs(across) - 0.25 * radius)
        distance = np.hypot(du, dv) - radius if shape % 2 else bar
        color = linear_color(colors[shape % len(colors)])
        picture += 0.85 * _smooth_step(-distance, -0.003, 0.005)[..., None] * (color - picture)
    return albedo(picture, 0.08 * spectral_noise(size, rng, 0.9))


def _coordinate(size: int) -> Array:
    return (np.arange(size) + 0.5) / size


def _smooth_step(value: Array, low: float, high: float) -> Array:
    fraction = np.clip((value - low) / (high - low), 0.0, 1.0)
    return fraction * fraction * (3 - 2 * fraction)


def _blend(colors: Sequence[str], position: Array) -> Array:
    """Interpolate the sequence of colors at positions from 0 to 1."""
    palette = np.array([linear_color(color) for color in colors])
    knots = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(position, knots, channel) for channel in palette.T], axis=-1)


def _bond(size: int, rows: int, columns: int, shift: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return for each texel the row and column of its brick and the distance, in tiles, from the brick's edge."""
    v = np.repeat(_coordinate(size)[:, None], size, axis=1)
    row = np.floor(v * rows).astype(np.int64)
    u = (_coordinate(size)[None, :] + shift[row]) % 1
    column = np.floor(u * columns).astype(np.int64)
    edge_u = (0.5 - np.abs(u * columns % 1 - 0.5)) / columns
    edge_v = (0.5 - np.abs(v * rows % 1 - 0.5)) / rows
    return row, column, np.minimum(edge_u, edge_v)
