"""What a dataset holds, and how Nerfstudio is given it."""
