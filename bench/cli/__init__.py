"""The `bench` command."""

from bench.cli.app import main
from bench.cli.console import JsonOption, console, print_rows, write_json

__all__ = ["JsonOption", "console", "main", "print_rows", "write_json"]
