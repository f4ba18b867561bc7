"""`python -m cconv` is `cconv`."""

from cconv.cli import main

main()
