"""Reports of runs and models."""
