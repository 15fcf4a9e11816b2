"""What looks after the instruments of a rig outside of runs: making them safe, clearing errors, checking them."""
