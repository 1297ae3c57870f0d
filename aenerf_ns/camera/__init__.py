"""Where a pixel looks, and when."""
