"""`python -m agents.cli`: the command line."""

from agents.cli.main import main

main()
