"""A lab bench for smart-material actuators: instruments, protocols, identification and control."""
