"""Taking up a run that died, and repeating one from its record."""
