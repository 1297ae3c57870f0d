"""Camera poses in continuous time."""
