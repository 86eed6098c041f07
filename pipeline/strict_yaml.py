"""YAML that a person wrote: plain values, and each key of a mapping once."""

from typing import Any

import yaml


class _EachKeyOnce(yaml.constructor.SafeConstructor):
    """Refuses a mapping with a repeated key, of which YAML's own constructor takes the last value."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value]
        for place, (key, _) in enumerate(node.value):
            if key.value in names[:place]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} is given twice", key.start_mark
                )
        return super().construct_mapping(node, deep)


class StrictLoader(_EachKeyOnce, yaml.SafeLoader):
    """What reads a person's YAML: plain values, and each key of a mapping once."""


class FastStrictLoader(_EachKeyOnce, yaml.CSafeLoader):
    """The same in C, for long files; what is nested thousands deep ends the process."""
