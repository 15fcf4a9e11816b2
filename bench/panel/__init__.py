"""The panel: a rig under the operator's hands, or a run in progress, at the terminal."""
