"""The choice among models by held-out errors."""
