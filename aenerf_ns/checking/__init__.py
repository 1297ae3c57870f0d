"""Whether poses and intrinsics fit the events."""
