"""Pages of runs as self-contained HTML files, for a log book."""
