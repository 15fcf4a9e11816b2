"""Controllers and exact inverses: numbers in, numbers out."""
