"""What the engine talks to: a rig with its interlocks and its safe state, in this process or held by a guardian."""
