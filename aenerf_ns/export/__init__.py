"""Exports of a trained run to other tools: cameras, frames, points, meshes and videos."""
