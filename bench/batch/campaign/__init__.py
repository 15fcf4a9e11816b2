"""Campaigns: many runs on emulated rigs from one file, over processes or a cluster, and a table of their results."""
