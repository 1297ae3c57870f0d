"""The registered methods: AE-NeRF, AE-NeRF with the paper's networks, and other papers' methods."""
