"""The one exception for what the user can mend: what, where, what to do, in one line."""

from __future__ import annotations

import reprlib

LINE_LIMIT = 2000  # characters of an error: what to do stands at its end and has to be seen
NAME_LIMIT = 200  # of a name or a value in it


class SaccadeError(Exception):
    """Bad input or a missing piece of the machine. Printed as one line, exit code 2, never as a traceback."""

    def __str__(self) -> str:
        return printable(super().__str__(), LINE_LIMIT)


def printable(text: str, limit: int = 400) -> str:
    """The text as a terminal can show it: control codes, lone surrogates and changes of direction are escaped, and of
    what is longer than `limit` characters the middle is left out."""
    shown = _without_middle(text, limit)
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return _without_middle(shown, limit)


def _without_middle(text: str, limit: int) -> str:
    return text if len(text) <= limit + 5 else f"{text[:limit - limit // 2]} ... {text[-(limit // 2):]}"


def is_text(text: str) -> bool:
    """Whether a text is Unicode and has no control codes: it can go into messages, and does nothing to a terminal."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return not any(ord(c) < 32 or 127 <= ord(c) < 160 for c in text)


def told(value: object) -> str:
    """A value from outside as an error names it: a text in quotes, and of what is long or deep only a part."""
    if isinstance(value, str):
        return f"'{printable(value, NAME_LIMIT)}'"
    return printable(reprlib.repr(value), NAME_LIMIT)
