"""``aenerf export-mesh``: a mesh of a trained run, in the units of the recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.operands import RunConfig
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.errors import DataError


@dataclass
class ExportMesh:
    """Fuse the depths that a trained run renders along its corrected trajectory in a truncated signed distance field,
    and write the surface as a coloured mesh, in the world and the units of the recording."""

    load_config: RunConfig
    output: Path
    """Mesh file to write: .ply, .glb or .obj."""
    resolution: int = 256
    """Voxels along the longest side of the box: the scene's box where the dataset states one, else the box of what the
    views see."""
    num_views: int = 60
    """Views, evenly spread over the time of the run."""

    def main(self) -> None:
        """Load the run, extract the mesh and write it."""
        if self.output.suffix not in (".ply", ".glb", ".obj"):
            raise DataError(self.output, "not a mesh file", "choose another --output, ending with .ply, .glb or .obj")
        if not 8 <= self.resolution <= 2048:
            raise DataError("aenerf export-mesh", f"a resolution of {self.resolution}", "give one from 8 to 2048")
        # Imported lazily, because these imports take seconds.
        import trimesh

        from aenerf_ns.export.mesh import extract_mesh

        _, pipeline, _ = open_run(self.load_config, test_mode="inference")
        mesh = extract_mesh(pipeline, self.num_views, self.resolution)
        written = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
        self.output.parent.mkdir(parents=True, exist_ok=True)
        written.export(self.output)
        sides = " x ".join(f"{side:.3g}" for side in written.extents)
        CONSOLE.print(
            f"{self.output}: {len(mesh.faces)} triangles, {sides} units of the recording.",
            highlight=False,
            soft_wrap=True,
        )
