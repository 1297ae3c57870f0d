"""The scenes that the benchmark measures on, built from CC0 assets."""
