"""The benchmark: its runs, how they are made, and what is written about them."""
