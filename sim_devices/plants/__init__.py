"""Plants of the emulated laboratory: physics only, advanced in time by whoever owns the clock."""
