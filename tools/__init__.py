"""Commands for maintainers. Run them from the root of a clone: `python -m tools.NAME --help`."""
