"""Additions to Nerfstudio's viewer: events, trajectories, live figures and exports."""
