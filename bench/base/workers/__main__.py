"""`python -m bench.base.workers` is a worker process: tasks come by its input, results leave by its output."""

from bench.base.workers.process import main

if __name__ == "__main__":
    main()
