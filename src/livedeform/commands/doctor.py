"""livedeform doctor."""

from __future__ import annotations

import typer


def doctor() -> None:
    """Checks the installation, and says what is missing.

    Exit code 1 if something that is needed does not work.

    Example: livedeform doctor
    """
    from livedeform.doctor import examine

    missing = 0
    for check in examine():
        word = {True: "ok", False: "MISSING", None: "note"}[check.ok]
        typer.echo(f"{word:8}{check.name:15}{check.found}" + (f"; {check.remedy}" if check.remedy else ""))
        missing += check.ok is False
    typer.echo("everything that is needed works" if not missing else f"{missing} of the checks failed")
    if missing:
        raise typer.Exit(1)
