"""What goes on to other tools from a trained run: cameras, frames, points, meshes and videos."""
