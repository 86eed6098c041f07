"""Loaders for YAML that a person wrote: plain values, and no repeated key in a mapping."""

import re
from itertools import chain
from typing import Any

import yaml


class _EachKeyOnce(yaml.constructor.SafeConstructor):
    """Constructor that rejects a mapping with a repeated key; YAML's own constructor takes the last value."""

    def construct_document(self, node: yaml.Node) -> Any:
        # Keys are checked before construction, in which a merge key (<<) copies pairs from one mapping into another.
        nodes, visited = [node], {node}
        for current in nodes:
            pairs = current.value if isinstance(current, yaml.MappingNode) else []
            names = [key.value for key, _ in pairs]
            for place, (key, _) in enumerate(pairs):
                if key.value in names[:place]:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key.value!r} is repeated", key.start_mark
                    )
            parts = current.value if isinstance(current, yaml.SequenceNode) else list(chain.from_iterable(pairs))
            nodes += [part for part in dict.fromkeys(parts) if part not in visited]
            visited.update(parts)
        return super().construct_document(node)


class StrictLoader(_EachKeyOnce, yaml.SafeLoader):
    """Loader of a person's YAML: plain values, and no repeated key in a mapping.

    Unlike YAML 1.1, ``yes``, ``off``, ``0123`` (octal 83) and ``1:30`` (90 in base 60) are text.
    """


StrictLoader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", "[-+]?(0|[1-9][0-9]*)", "-+0123456789"),
    (
        "float",
        r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("merge", "<<", "<"),
):
    StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"({_pattern})$"), list(_first))


class _StrictDumper(yaml.SafeDumper):
    """Dumper whose plain text ``StrictLoader`` reads as text."""


def _text(dumper: _StrictDumper, text: str) -> yaml.Node:
    """Represent a text, in quotes if ``StrictLoader`` reads it as another value."""
    resolver: Any = StrictLoader("")
    plain = resolver.resolve(yaml.ScalarNode, text, (True, False)) == "tag:yaml.org,2002:str"
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else "'")


def _list(dumper: _StrictDumper, entries: list[Any]) -> yaml.Node:
    """Represent a list, on one line if it has no list or mapping."""
    flat = not any(isinstance(entry, list | dict) for entry in entries)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", entries, flow_style=flat)


_StrictDumper.add_representer(str, _text)
_StrictDumper.add_representer(list, _list)


def dump(content: Any) -> str:
    """Return the YAML of plain values, which ``StrictLoader`` reads as the same values."""
    return str(yaml.dump(content, Dumper=_StrictDumper, sort_keys=False, default_flow_style=False, width=120))


class FastStrictLoader(_EachKeyOnce, yaml.CSafeLoader):
    """Loader in C for long files, which rejects repeated keys too. Thousands of nested levels end the process."""
