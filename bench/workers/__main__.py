"""`python -m bench.workers` is a worker process: tasks come in by its standard input, results leave by its output."""

from bench.workers.process import main

main()
