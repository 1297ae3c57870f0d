"""Where rays enter and leave a bounded scene."""

from __future__ import annotations

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.scene_colliders import AABBBoxCollider

# The length of the interval that the framework gives to rays that miss the box, up to rounding.
_MISSED = 1e-5


class BoxCollider(AABBBoxCollider):
    """The framework's box collider, but rays that miss the box end behind it, and the near plane always holds.

    The framework lets rays that miss the box end anywhere, often at the camera. The depth of such a ray is its end, so
    it would hide whatever the viewer draws behind: the training cameras around an object. And the framework drops the
    near plane outside training, so a camera inside the box would see matter that no training ray has passed.
    """

    def set_nears_and_fars(self, ray_bundle: RayBundle) -> RayBundle:
        """Fill in ``nears`` and ``fars`` (N, 1), distances in scene units."""
        ray_bundle = super().set_nears_and_fars(ray_bundle)
        nears = ray_bundle.nears.clamp_min(self.near_plane)
        fars = torch.maximum(ray_bundle.fars, nears)
        aabb = self.scene_box.aabb.to(nears)
        to_center = (ray_bundle.origins - aabb.mean(0)).norm(dim=-1, keepdim=True)
        behind = to_center + (aabb[1] - aabb[0]).norm()
        missed = fars - nears < _MISSED
        ray_bundle.nears = torch.where(missed, behind, nears)
        ray_bundle.fars = torch.where(missed, behind + _MISSED, fars)
        return ray_bundle
