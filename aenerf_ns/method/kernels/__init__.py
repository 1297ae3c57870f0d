"""Compiled kernels of the field: numba on the CPU, Triton on the GPU."""
