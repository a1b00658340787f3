"""YAML from outside as plain values."""

from __future__ import annotations

from typing import Any

import yaml

_LONGEST = 8 << 20
"""Characters: PyYAML takes hundreds of bytes of memory, and ten microseconds, for each."""


class _PlainLoader(yaml.SafeLoader):
    """Builds lists, dicts, texts, numbers and dates. There are no tags, whose constructors fail in many ways on what is
    not theirs, and no mapping merges others, of which a few lines fill any memory."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            raise yaml.composer.ComposerError(None, None, f"{event.tag} has no place here", event.start_mark)
        return super().compose_node(parent, index)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "<< has no place here", key.start_mark)


class _TagBlindLoader(_PlainLoader):
    """As if there were no tags in the text."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.NodeEvent):
            event.tag = None
        return super().compose_node(parent, index)


def parse_yaml(text: str, ignore_tags: bool = False) -> Any:
    """The value of a YAML text of at most 8 Mi characters. Nothing is executed, whatever tags say.

    Raises:
        ValueError: it is none, or longer.
    """
    if len(text) > _LONGEST:
        raise ValueError("it is longer than 8 MiB")
    try:
        return yaml.load(text, Loader=_TagBlindLoader if ignore_tags else _PlainLoader)  # both are SafeLoaders
    except (yaml.YAMLError, RecursionError, OverflowError) as error:
        raise ValueError(getattr(error, "problem", None) or str(error).partition("\n")[0]) from None
