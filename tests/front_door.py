"""The command `saccade` within this process, and what it prints."""

from __future__ import annotations

import sys

import pytest

from saccade.app.cli import main as cli


def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    monkeypatch.setattr(sys, "argv", ["saccade", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    out, err = capsys.readouterr()
    return end.value.code or 0, out, err


def rows(out: str) -> dict[str, list[str]]:
    """The cells of a printed table by the first of their row."""
    lines = ([cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if line.startswith("│"))
    return {first: cells for first, *cells in lines}
