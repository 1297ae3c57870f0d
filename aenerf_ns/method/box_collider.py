"""Where rays enter and leave a bounded scene."""

from __future__ import annotations

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components.scene_colliders import AABBBoxCollider
from torch import Tensor, nn

# Rays that see less than this length of the box miss it, in scene units.
_MISSED = 1e-5


class BoxCollider(AABBBoxCollider):
    """The framework's box collider, but rays that miss the box end behind it, and the near plane always holds.

    The framework lets rays that miss the box end anywhere, often at the camera. The depth of such a ray is its end, so
    it would hide whatever the viewer draws behind: the training cameras around an object. And the framework drops the
    near plane outside training, so a camera inside the box would see matter that no training ray has passed.
    """

    def __init__(self, scene_box: SceneBox, near_plane: float) -> None:
        super().__init__(scene_box, near_plane)
        # A buffer, because copying the box for every batch would wait for the GPU.
        self._aabb: Tensor = nn.Buffer(scene_box.aabb.clone(), persistent=False)
        self._diagonal = float((scene_box.aabb[1] - scene_box.aabb[0]).norm())

    def set_nears_and_fars(self, ray_bundle: RayBundle) -> RayBundle:
        """Fill in ``nears`` and ``fars`` (N, 1), distances in scene units."""
        # A ray may have no component along an axis.
        sides = (self._aabb[:, None] - ray_bundle.origins) * (1 / (ray_bundle.directions + 1e-6))
        nears = sides.amin(0).amax(-1, keepdim=True).clamp_min(self.near_plane)
        fars = torch.maximum(sides.amax(0).amin(-1, keepdim=True), nears)
        to_center = (ray_bundle.origins - self._aabb.mean(0)).norm(dim=-1, keepdim=True)
        behind = to_center + self._diagonal
        missed = fars - nears < _MISSED
        ray_bundle.nears = torch.where(missed, behind, nears)
        ray_bundle.fars = torch.where(missed, behind + _MISSED, fars)
        return ray_bundle
