"""The reference pages of the guide say what the code says: every key, field, option and constant."""

from __future__ import annotations

import pytest

from saccade.app.constants import constants
from saccade.app.reference import attribute_docstrings, main, pages
from saccade.shared.bus.messages import field_types
from saccade.shared.bus.topics import TOPICS
from saccade.shared.config import PACKAGE, Config

TOLD = pages()


@pytest.mark.parametrize("name", TOLD)
def test_the_page_in_the_guide_is_the_generated_one(name):
    """`make docs` writes them anew."""
    assert (PACKAGE / "docs" / name).read_text() == TOLD[name]


def test_every_topic_and_every_field_is_described():
    for topic in TOPICS.values():
        assert f"`saccade/<world>/{topic.name}" in TOLD["wire.md"]
        described = attribute_docstrings(topic.type)
        for field in field_types(topic.type):
            assert described[field].endswith("."), f"{topic.type.__name__}.{field}"
            assert f"| `{field}` |" in TOLD["wire.md"]


def test_every_key_of_the_configuration_is_described():
    for name, field in Config.model_fields.items():
        sections = getattr(field.annotation, "model_fields", None)
        for key, inner in sections.items() if sections else ((name, field),):
            assert (inner.description or "").endswith("."), f"{name}.{key}"
            assert f"| `{name}.{key}` |" in TOLD["reference/configuration.md"] or key == name


def test_every_constant_says_where_it_is_from():
    found = list(constants())
    assert len(found) > 50
    for constant in found:
        assert constant.comment, constant.label
        assert f"`{constant.label}`" in TOLD["reference/constants.md"]


def test_the_pages_are_written(tmp_path):
    main(tmp_path)
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.md")} == set(TOLD)
