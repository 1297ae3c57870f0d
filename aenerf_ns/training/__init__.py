"""How the model is fed and run."""
