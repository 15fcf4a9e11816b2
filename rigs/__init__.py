"""One folder a rig: rig files, laboratory, and the models, controllers, study and commands that only it has."""
