"""Other papers' supervision, on the same field."""
