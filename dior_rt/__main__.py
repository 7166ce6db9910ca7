"""`python -m dior_rt` is `dior-rt`."""

from dior_rt.cli import main

main()
