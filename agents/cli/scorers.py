"""``ae-env scorers``: all scorers."""

from __future__ import annotations

from agents.cli.console import console, print_line


def scorers() -> None:
    """List all known scorers, those of installed packages included.

    Example: `ae-env scorers` lists them; docs/plug-in-a-scorer.md says how to add one.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from ae_env.scorers.registry import describe_scorers

    table = Table(title="scorers: all in [0, 1], higher is better", box=box.SIMPLE_HEAD)
    for title in ("name", "sees", "depends on"):
        table.add_column(title, no_wrap=True)
    table.add_column("what it is", overflow="fold")
    for row in describe_scorers():
        what = Text(f"broken: {row.error}", "red") if row.error else Text(row.summary)
        if row.needs:
            what.append(f" Needs {row.needs}.", "dim")
        if row.package != "ae-env":
            what.append(f" From {row.package}.", "dim")
        table.add_row(Text(row.name), row.domain, row.depends_on, what)
    console.print(table)
    print_line("and by name: my_file.py:MyScore, package.module:MyScore, pyiqa:METRIC")
