"""`python -m parallel_cal.cli`."""

from parallel_cal.cli.main import main

main()
