"""How a batch is drawn, and what its renderings are compared with."""
