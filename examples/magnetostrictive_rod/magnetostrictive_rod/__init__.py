"""A magnetostrictive rod in a coil, as a rig of the bench: the `*.toml` files of this package are the rigs."""
