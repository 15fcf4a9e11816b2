"""Data, models, figures and reports made from the records of runs."""
