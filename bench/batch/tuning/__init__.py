"""Controllers tuned on an emulated rig or a twin: the search and its cost, and the file of numbers that it leaves."""
