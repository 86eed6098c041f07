"""YAML that a person wrote: plain values, and each key of a mapping once."""

import re
from typing import Any

import yaml


class _EachKeyOnce(yaml.constructor.SafeConstructor):
    """Refuses a mapping with a repeated key, of which YAML's own constructor takes the last value."""

    def construct_document(self, node: yaml.Node) -> Any:
        # Before anything is constructed: a merge key (<<) then copies pairs from one mapping into another.
        nodes, known = [node], {node}
        for one in nodes:
            pairs = one.value if isinstance(one, yaml.MappingNode) else []
            names = [key.value for key, _ in pairs]
            for place, (key, _) in enumerate(pairs):
                if key.value in names[:place]:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key.value!r} is given twice", key.start_mark
                    )
            parts = one.value if isinstance(one, yaml.SequenceNode) else [part for pair in pairs for part in pair]
            nodes += [part for part in dict.fromkeys(parts) if part not in known]
            known.update(parts)
        return super().construct_document(node)


class StrictLoader(_EachKeyOnce, yaml.SafeLoader):
    """What reads a person's YAML: plain values, and each key of a mapping once.

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


class FastStrictLoader(_EachKeyOnce, yaml.CSafeLoader):
    """Each key once too, in C, for long files; what is nested thousands deep ends the process."""
