"""A hook of MkDocs: shows mkdocstrings a folder with the documented parts of the package `saccade` and nothing else.

In a checkout the package is the root of the repository. There mkdocstrings would search `.venv` too, for a minute.
"""

import tempfile
from pathlib import Path

from mkdocs.plugins import event_priority

import saccade

ROOMS = ("__init__.py", "app", "services", "shared")

_names = tempfile.TemporaryDirectory(prefix="saccade-guide-")  # removed when MkDocs ends


@event_priority(100)
def on_config(config):
    """Before mkdocstrings looks for the package."""
    package = Path(_names.name, "saccade")
    package.mkdir(exist_ok=True)
    for room in ROOMS:
        link = package / room
        if not link.is_symlink():
            link.symlink_to(Path(saccade.__file__).parent / room)
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [_names.name]
    return config
