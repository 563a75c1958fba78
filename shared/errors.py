"""The exception for everything that the user can repair. Its text says in one line what is wrong, where, and what to
do."""

from __future__ import annotations

import reprlib

LINE_LIMIT = 2000  # characters of an error; its end says what to do and must be seen
NAME_LIMIT = 200  # characters of a name or a value in an error


class SaccadeError(Exception):
    """The input is wrong, or something is missing on this machine. It is printed as one line without a traceback, with
    exit code 2."""

    def __str__(self) -> str:
        return printable(super().__str__(), LINE_LIMIT)


def printable(text: str, limit: int = 400) -> str:
    """Returns the text as a terminal can show it. Control codes, lone surrogates and changes of direction are escaped.
    If the text is longer than `limit` characters, its middle is left out."""
    shown = _without_middle(text, limit)
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return _without_middle(shown, limit)


def _without_middle(text: str, limit: int) -> str:
    return text if len(text) <= limit + 5 else f"{text[:limit - limit // 2]} ... {text[-(limit // 2):]}"


def is_text(text: str) -> bool:
    """Whether a text is valid Unicode without control codes. Such a text can be put into messages and is harmless on a
    terminal."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return not any(ord(c) < 32 or 127 <= ord(c) < 160 for c in text)


def told(value: object) -> str:
    """Returns a value from outside as an error names it: a text in quotes, and only a part of what is long or deep."""
    if isinstance(value, str):
        return f"'{printable(value, NAME_LIMIT)}'"
    try:
        return printable(reprlib.repr(value), NAME_LIMIT)
    except ValueError:  # Python writes no number with thousands of digits
        return "a number that is too large"
