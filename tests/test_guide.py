"""The guide builds without a warning; files, commands, options and keys that it and the root pages name exist."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from typer.main import get_command

import saccade
from saccade.app.cli.main import app
from saccade.shared.config import PACKAGE, Config

ROOT_PAGES = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
MADE_BY_REPORT = ("report.md", "failures.md", "ablations")
GUIDE = PACKAGE / "docs"
WRITTEN = [PACKAGE / name for name in ROOT_PAGES] + sorted(
    page for page in GUIDE.rglob("*.md") if page.relative_to(GUIDE).parts[0] not in MADE_BY_REPORT)
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
CALL = re.compile(r"(?:\w+=\S+ )*(?:\S*/)?(?:saccade|python -m saccade)(?!\S)(?P<rest>.*)")
FETCHES = re.compile(r"""<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=["']?((?:https?:)?//[^"' >]+)""")


class Command(NamedTuple):
    """A call of `saccade` that a page shows."""

    page: str
    words: tuple[str, ...]


def built(folder: Path, site: Path, *, execute: bool = False) -> subprocess.CompletedProcess[str]:
    """MkDocs on a copy of the guide. `make docs` executes the tutorial, too."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", folder / "mkdocs.yml", "-d", site]
    return subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300,
                          env=os.environ | {"EXECUTE_TUTORIAL": str(execute).lower()})


@pytest.fixture
def guide(tmp_path: Path) -> Path:
    """A copy of the guide and of its settings."""
    shutil.copytree(GUIDE, tmp_path / "docs")
    shutil.copy(PACKAGE / "mkdocs.yml", tmp_path)
    return tmp_path


def code(page: Path, *languages: str) -> Iterator[str]:
    """The blocks of code in these languages."""
    for language, text in FENCE.findall(page.read_text()):
        if language in languages:
            yield text


def spans(page: Path) -> Iterator[str]:
    """What stands between single backticks."""
    yield from re.findall(r"`([^`\n]+)`", FENCE.sub("", page.read_text()))


def commands(page: Path) -> Iterator[Command]:
    """Every call of `saccade` in blocks of code and between backticks."""
    lines = [line for text in code(page, "sh") for line in text.replace("\\\n", " ").splitlines()]
    for line in (*lines, *spans(page)):
        match = CALL.match(line)
        if match:
            yield Command(page.name, tuple(shlex.split(match["rest"], comments=True)))


def problems(command: Command) -> list[str]:
    """What is wrong with a call: a command, an option or a key that does not exist."""
    known: Any = get_command(app)
    words, found = list(command.words), []
    while hasattr(known, "commands") and words and not words[0].startswith("-"):
        if words[0].isupper():  # COMMAND
            return []
        if words[0] not in known.commands:
            return [f"{command.page}: there is no command {words[0]!r} in {' '.join(command.words)!r}"]
        known = known.commands[words.pop(0)]
    options = {name for parameter in known.params for name in (*parameter.opts, *parameter.secondary_opts)} | {"--help"}
    for number, word in enumerate(words):
        option, _, value = word.partition("=")
        if option.startswith("--") and option not in options:
            found.append(f"{command.page}: there is no option {option!r} in {' '.join(command.words)!r}")
        if option == "--set" and known.name != "train" and not is_key(value or words[number + 1]):
            found.append(f"{command.page}: there is no such key: {' '.join(words[number:number + 2])!r}")
    return found


def is_key(text: str) -> bool:
    """Whether KEY of KEY=VALUE is one of the configuration."""
    key = text.partition("=")[0]
    node: Any = Config().model_dump(mode="json")
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return key == "KEY"
        node = node[part]
    return True


def test_the_guide_builds_without_a_warning_and_fetches_nothing_from_elsewhere(guide, tmp_path):
    done = built(guide, tmp_path / "site", execute=True)
    assert done.returncode == 0, done.stdout
    assert (tmp_path / "site" / "tutorial" / "index.html").read_text().count('src="data:image/png') == 3
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 20
    fetched = {address for page in pages for address in FETCHES.findall(page.read_text())}
    assert {address for address in fetched if not address.startswith("https://squidfunk.github.io")} == set()
    assert "world_from_camera" in (tmp_path / "site" / "reference" / "python" / "index.html").read_text()


def test_a_broken_link_or_anchor_stops_the_build(guide, tmp_path):
    with (guide / "docs" / "limits.md").open("a") as page:
        page.write("\n[a page](nowhere.md), [a heading](index.md#nowhere)\n")
    done = built(guide, tmp_path / "site")
    assert done.returncode != 0
    assert "'nowhere.md'" in done.stdout
    assert "'#nowhere'" in done.stdout or "index.md#nowhere" in done.stdout


@pytest.mark.parametrize("name", ROOT_PAGES)
def test_links_of_the_pages_beside_the_guide_lead_somewhere(name):
    text = FENCE.sub("", (PACKAGE / name).read_text())
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not link.startswith("http")]
    assert links
    for link in links:
        path, _, anchor = link.partition("#")
        target = PACKAGE / (path or name)
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(PACKAGE)))
def test_every_command_option_and_key_exists(page):
    assert [problem for command in commands(page) for problem in problems(command)] == []


def test_commands_are_found_and_wrong_ones_are_told(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("Call `saccade walk` or `saccade log check RUN`.\n\n```sh\n"
                    "A=b saccade run --fly --set planner.stride=3   # --comment\n"
                    "python -m saccade view --live\n```\n")
    found = list(commands(page))
    assert [command.words[0] for command in found] == ["run", "view", "walk", "log"]
    told = [problem.partition(": there is no ")[2] for command in found for problem in problems(command)]
    assert [text.partition(" in ")[0] for text in told] == [
        "option '--fly'", "such key: '--set planner.stride=3'", "command 'walk'"]


def test_the_pages_show_commands():
    assert len([command for page in WRITTEN for command in commands(page)]) > 60


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(PACKAGE)))
def test_programs_parse_and_modules_and_targets_exist(page):
    for text in code(page, "python"):
        compile(text, page.name, "exec")
        for name in re.findall(r"\bsaccade\.(\w+)\(", text):
            assert hasattr(saccade, name), name
    for text in code(page, "json"):
        json.loads(text)
    shown = "\n".join([*code(page, "sh"), *spans(page)])
    for module in re.findall(r"python -m (saccade(?:\.\w+)+)", shown):
        assert find_spec(module), module
    makefile = (PACKAGE / "Makefile").read_text()
    for target in re.findall(r"^(?:\S+=\S+ )*make ([a-z-]+)", shown, re.MULTILINE):
        assert f"\n{target}:" in makefile, target
