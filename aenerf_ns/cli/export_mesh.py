"""``aenerf export-mesh``: a mesh of a trained run, in the units of the recording."""

from __future__ import annotations

from dataclasses import dataclass

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.export_arguments import ExportMeshArguments
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.files.output_paths import created


@dataclass
class ExportMesh(ExportMeshArguments):
    __doc__ = ExportMeshArguments.__doc__

    def main(self) -> None:
        """Load the run, extract the mesh and write it."""
        self.judge()
        # Imported lazily, because these imports take seconds.
        import trimesh

        from aenerf_ns.export.mesh import extract_mesh

        _, run, _ = open_run(self.load_config, test_mode="inference")
        mesh = extract_mesh(run, self.num_views, self.resolution)
        written = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
        with created(self.output, "--output"):
            written.export(self.output)
        sides = " x ".join(f"{side:.3g}" for side in written.extents)
        CONSOLE.print(
            f"{self.output}: {len(mesh.faces)} triangles, {sides} units of the recording.",
            highlight=False,
            soft_wrap=True,
        )
