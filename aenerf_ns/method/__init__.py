"""The method of docs/method.md as code: field, poses, color, model."""
