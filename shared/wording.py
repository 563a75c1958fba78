"""Says in plain words what is wrong with a value, instead of the words of the library that checks it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saccade.shared.errors import told

# By pydantic's name for what is wrong; the fields in braces are from its context
_NEEDED = {
    "greater_than": "give more than {gt:g}", "greater_than_equal": "give {ge:g} or more",
    "less_than": "give less than {lt:g}", "less_than_equal": "give {le:g} or less",
    "finite_number": "give a finite number",
    "literal_error": "choose from {expected}",
    "string_too_long": "give a text of at most {max_length} characters",
    "too_long": "give at most {max_length}",
    "string_pattern_mismatch": "give a text of the form {pattern}",
} | dict.fromkeys(("int_type", "int_parsing", "int_parsing_size", "int_from_float"), "give a whole number") \
  | dict.fromkeys(("float_type", "float_parsing"), "give a number") \
  | dict.fromkeys(("bool_type", "bool_parsing"), "give true or false") \
  | dict.fromkeys(("string_type", "path_type"), "give a text") \
  | dict.fromkeys(("tuple_type", "list_type"), "give a list such as [1, 2]") \
  | dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "give a section with keys")

# Patterns of the configuration, and what they mean
MODULE = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*$"
WORLD = r"^[A-Za-z0-9_-]{1,64}$"
TOKEN = r"^[A-Za-z0-9_-]{16,128}$"
ROS_NAME = r"^(/[A-Za-z_][A-Za-z0-9_]*)+$"
_FORMS = {
    MODULE: "give the name of a Python module, such as my_package.my_module",
    WORLD: "give at most 64 letters, digits, - and _",
    TOKEN: "give 16 to 128 letters, digits, - and _",
    ROS_NAME: "give a name of ROS, such as /saccade",
}


def label_of(name: str, instance: int) -> str:
    """What one of several objects of a kind is called: `soup_can` for the first one, `soup_can#2` for the second. No
    object's own name has a `#`."""
    return name if instance == 1 else f"{name}#{instance}"


def plain(error: Mapping[str, Any]) -> str:
    """Returns what to do about an error of pydantic (an entry of its `errors()`)."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        return "there is no such key"
    if kind == "missing":
        return "it is missing"
    if kind == "string_pattern_mismatch" and context["pattern"] in _FORMS:
        return _FORMS[context["pattern"]]
    if kind in _NEEDED:
        return _NEEDED[kind].format(**context)
    return str(error["msg"]).removeprefix("Value error, ")


def plain_of(error: Mapping[str, Any]) -> str:
    """Returns the same, with the value that was given."""
    needs = error["type"] in _NEEDED
    return plain(error) + (f", not {told(error['input'])}" if needs else "")
