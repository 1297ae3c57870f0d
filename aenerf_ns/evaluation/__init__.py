"""What is done with a trained run: metrics of its views, errors and a diagnosis of its poses, its color correction."""
