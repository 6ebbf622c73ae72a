"""Checks whether a path may be written, and writing that is complete or leaves nothing."""

from gyrostab.store.output.check import check_folder, check_output, check_target, resolve_link
from gyrostab.store.output.content import find_foreign_item, read_json
from gyrostab.store.output.inputs import describe_file, find_sources, protect_inputs
from gyrostab.store.output.write import (
    hide_name,
    is_leftover,
    new_folder,
    new_output,
    remove_leftovers,
    replace_file,
    write_text,
)

__all__ = [
    "check_folder",
    "check_output",
    "check_target",
    "describe_file",
    "find_foreign_item",
    "find_sources",
    "hide_name",
    "is_leftover",
    "new_folder",
    "new_output",
    "protect_inputs",
    "read_json",
    "remove_leftovers",
    "replace_file",
    "resolve_link",
    "write_text",
]
