"""`python -m ae_env`: the command line."""

from ae_env.cli import main

main()
