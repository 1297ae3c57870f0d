"""The paper's tables 1, 3 and 4 on simulated scenes: which runs they need, how the runs are made, and the report."""
