"""Plants of the emulated laboratory: physics only, advanced in time by the owner of the clock."""
