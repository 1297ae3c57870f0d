"""A report of trained runs: what is measured of them, and the page that shows it."""
