"""The program ``ae-env``: finds the command line among the packages that are installed together."""

from __future__ import annotations

import importlib

from ae_env.utils.packages import check_package


def main() -> None:
    """Runs `agents.cli.main`.

    Raises:
        ImportError: If another package of the name comes first on ``sys.path``.
        SystemExit: With 130 after Ctrl-C, also while the libraries are loaded, which takes seconds.
    """
    check_package("agents")
    try:
        program = importlib.import_module("agents.cli.main")
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    program.main()
