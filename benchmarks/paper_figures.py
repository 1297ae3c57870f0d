"""Draw of trained runs what the paper's figures show: samples along rays, the camera's path, and renderings of views.

    python -m benchmarks.paper_figures --runs default outputs/default temporal outputs/temporal --output figures

The samples and the path are of the first run. The views of all runs are beside each other, with the truth, for instance
of runs with and without a loss. Distances are in units of the recording.
"""

from __future__ import annotations

import gc
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfacc import OccGridEstimator
from nerfacc.grid import _query
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.utils.colormaps import apply_depth_colormap
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import to_image, view_files
from aenerf_ns.report.comparison import Protocol, protocol_differences, read_protocol
from aenerf_ns.report.poses import measure_poses
from benchmarks.paper.figures import draw_paths, error_map, picture_grid
from benchmarks.runs import run_benchmark

# Colors of the rays, and their places in shares of the width and height of the view.
_RAYS = {"tab:red": (0.3, 0.5), "tab:green": (0.5, 0.5), "tab:blue": (0.7, 0.5)}


@dataclass
class PaperFigures:
    """Draw the figures of trained runs."""

    runs: dict[str, Path]
    """Runs by the names that the figures give them: each a config.yml or a folder."""
    output: Path
    """Folder for the pictures."""
    views: int = 2
    """Test views to draw, evenly spread. The samples are drawn along rays of the first of them."""

    def main(self) -> None:
        """Draw all figures."""
        self.output.mkdir(parents=True, exist_ok=True)
        protocols: list[Protocol] = []
        tiles: dict[str, dict[str, list[NDArray[np.uint8]]]] = {}
        for name, path in self.runs.items():
            _, run, _ = open_run(path)
            protocols.append(read_protocol(run))
            if different := protocol_differences([*self.runs][: len(protocols)], protocols):
                raise DataError(path, f"runs measured differently: {'; '.join(different)}", "evaluate all alike")
            files = view_files(run)
            if not files:
                raise DataError(path, "its dataset has no test views", "name a run whose dataset has them")
            if not tiles:
                shown = [files[len(files) * (2 * n + 1) // (2 * self.views)] for n in range(self.views)]
                draw_samples(run, files.index(shown[0]), self.output / "samples.png")
                poses = measure_poses(run)
                errors = {name: (poses.seconds, of) for name, of in (poses.errors or {}).items()}
                draw_paths(poses.positions, errors, self.output / "paths.png")
            for file in shown:
                _add_view(run, files.index(file), name, tiles.setdefault(file, {}))
            del run
            gc.collect()
        for file, columns in tiles.items():
            picture_grid(columns).save(self.output / f"view_{Path(file).stem}.png", optimize=True)


@torch.no_grad()
def _add_view(run: TrainedRun, index: int, name: str, columns: dict[str, list[NDArray[np.uint8]]]) -> None:
    """Add a run's rendering of a test view with its error and its depth; the truth comes first."""
    assert run.views is not None
    camera = run.views.cameras[index : index + 1].to(run.device)
    outputs = run.model.get_outputs_for_camera(camera)
    image = {"image": run.views.get_image_float32(index)}
    metrics, pictures = run.model.get_image_metrics_and_images(outputs, image)
    true, rendered = np.split(np.asarray(to_image(pictures["img"])), 2, axis=1)
    distance, measured = outputs["depth"] * _units(run), _true_distance(run, index)
    near, far = (float((measured[measured > 0] if measured.any() else distance).quantile(q)) for q in (0.02, 0.98))
    truth, depth = (
        np.asarray(to_image(apply_depth_colormap(values, opacity, near, far)))
        for values, opacity in ((measured, (measured > 0).float()), (distance, outputs["accumulation"]))
    )
    columns.setdefault("truth", [true, np.zeros_like(true), truth])
    columns[f"{name}: {metrics['psnr']:.1f} dB"] = [rendered, error_map(rendered, true), depth]


def _units(run: TrainedRun) -> float:
    """Return the length of a unit of the scene in units of the true trajectory, or else of the recording."""
    return float(run.model.camera_optimizer.alignment().scale) / run.scene.scale


def _true_distance(run: TrainedRun, index: int) -> Tensor:
    """Return true distances (H, W, 1) along the rays of a view, 0 where the simulator wrote no depth."""
    assert run.views is not None
    along_ray = run.views.cameras.generate_rays(index).metadata["directions_norm"].to(run.device)
    name = view_files(run)[index]
    file = run.data / name.replace("images/", "depth/", 1)
    if not name.startswith("images/") or not file.is_file():
        return torch.zeros_like(along_ray)
    return torch.from_numpy(np.asarray(Image.open(file)) / np.float32(1000)).to(run.device)[..., None] * along_ray


@torch.no_grad()
def draw_samples(run: TrainedRun, index: int, file: Path) -> None:
    """Draw where the samples of rays of a test view are: even ones, those of an occupancy grid, and each round's.

    Above them are, of the trained field, the weight of each length of the ray, as a share of its highest, and the
    opacity up to there. Vertical lines are the rendered and, where it is known, the true distance of the surface.
    """
    from matplotlib.figure import Figure

    assert run.views is not None
    model, units, sampler = run.model, _units(run), run.model.proposal_sampler
    camera = run.views.cameras[index : index + 1].to(run.device)
    moved = replace(camera, camera_to_worlds=model.camera_optimizer.apply_to_camera(camera))
    pixels = torch.tensor(
        [[int(y * camera.height), int(x * camera.width)] for x, y in _RAYS.values()], device=run.device
    )
    rays = moved.generate_rays(torch.zeros_like(pixels[:, :1]), coords=pixels + 0.5)
    # Rendering leaves the field where the poses have moved it.
    surfaces = torch.cat([model.render_rays(rays, "depth")[0] * units, _true_distance(run, index)[tuple(pixels.T)]], 1)
    rays = model.collider(rays)
    samples, _, rounds = sampler(rays, density_fns=model.density_fns)
    fine = sampler.initial_sampler(rays, num_samples=4096)
    weights = fine.get_weights(model.field.get_density(fine)[0])[..., 0].cpu()
    density = weights / (fine.frustums.ends - fine.frustums.starts)[..., 0].cpu()
    density /= density.amax(1, keepdim=True).clamp_min(1e-9)
    rows: dict[str, Any] = {
        "even": _middles(sampler.initial_sampler(rays, num_samples=samples.shape[-1])),
        "occupancy grid": march(run, rays),
    }
    # The first round's samples are even.
    rows |= {f"proposals, round {n}": _middles(part) for n, part in enumerate(rounds[1:], start=2)}
    rows["field, by proposals"] = _middles(samples)
    figure = Figure(figsize=(12, 6), layout="constrained")
    view, *panels = figure.subplot_mosaic("ABB;ACC;ADD").values()
    view.imshow(to_image(model.get_outputs_for_camera(camera)["rgb"]))
    view.set(xticks=[], yticks=[], title="the rays in the rendered view")
    panels[0].set_title("samples, and how many of them are within 5 % of the surface's distance")
    for ray, (color, axes) in enumerate(zip(_RAYS, panels, strict=True)):
        view.plot(*pixels[ray].flip(0).tolist(), "o", color=color, markeredgecolor="white", markersize=9)
        lines = [float(line) for line in surfaces[ray] if line > 0]
        distances = {name: row[ray] * units for name, row in rows.items()}
        near = [int(((of - lines[-1]).abs() < 0.05 * lines[-1]).sum()) for of in distances.values()]
        labels = [f"{name}: {len(of)}, {count}" for (name, of), count in zip(distances.items(), near, strict=True)]
        places = [*range(0, -len(rows), -1)]
        axes.eventplot(
            [of.tolist() for of in distances.values()],
            lineoffsets=places,
            linelengths=0.7,
            linewidths=0.8,
            colors=color,
        )
        along = _middles(fine)[ray] * units
        axes.fill_between(along, 0.6, 0.6 + 2 * density[ray], color=color, alpha=0.5, linewidth=0)
        axes.plot(along, 0.6 + 2 * weights[ray].cumsum(0), color="black", linewidth=0.8)
        for line, style in zip(lines, ("--", ":"), strict=False):
            axes.axvline(line, color="black", linestyle=style, linewidth=1)
        axes.set_yticks([1.6, *places], ["weight, opacity", *labels])
        axes.set_xlim(0, 1.3 * max(lines))
    axes.set_xlabel("distance along the ray; dashed: the surface as rendered, dotted: the true surface")
    figure.savefig(file, dpi=80)


def _middles(samples: RaySamples) -> Tensor:
    """Return the distances (rays, samples) of the middles of samples, in scene units."""
    return ((samples.frustums.starts + samples.frustums.ends) / 2)[..., 0].cpu()


def march(run: TrainedRun, rays: RayBundle) -> list[Tensor]:
    """Return the distances of the samples of each ray where Instant-NGP's march puts them, with its constants.

    Its steps grow with the distance in unbounded scenes. It skips cells in which a step is nearly transparent, and ends
    where hardly any light comes from. nerfacc marches on a GPU only, so its grid is looked up step by step.
    """
    field, bounded = run.model.field, run.scene.bounded
    box = field.aabb if bounded else run.model.scene_box.aabb
    shortest, growth = math.sqrt(3) / 1024 * float((box[1] - box[0]).max()), 0 if bounded else 1 / 256
    grid = OccGridEstimator(box.flatten(), resolution=128, levels=1 if bounded else 4).to(run.device)
    torch.manual_seed(0)
    for update in range(2):
        # Each looks at another place in every cell.
        grid.update_every_n_steps(
            update, lambda x: torch.cat([field.density_fn(part) * shortest for part in x.split(1 << 18)]), n=1
        )
    edges = [float(rays.nears.min())]
    while edges[-1] < float(rays.fars.max()):
        edges.append(edges[-1] + max(shortest, growth * edges[-1]))
    ends = torch.tensor(edges, device=run.device)[None, :, None].expand(len(rays), -1, 1)
    samples = rays.get_ray_samples(ends[:, :-1], ends[:, 1:])
    occupied = _query(samples.frustums.get_positions().flatten(0, 1), grid.binaries, grid.aabbs[0])[0]
    occupied = occupied.unflatten(0, samples.shape)
    weights = samples.get_weights(field.get_density(samples)[0] * occupied[..., None])[..., 0]
    arriving = 1 - weights.cumsum(1) + weights
    used = (occupied & (arriving > 1e-4)).cpu()
    return [row[mask] for row, mask in zip(_middles(samples), used, strict=True)]


if __name__ == "__main__":
    run_benchmark(PaperFigures)
