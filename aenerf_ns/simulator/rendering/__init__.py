"""Pictures of lit meshes."""
