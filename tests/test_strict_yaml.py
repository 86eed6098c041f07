"""What a person's YAML is read as: keys, merge keys, numbers and booleans."""

from typing import Any

import pytest
import yaml

from pipeline.strict_yaml import FastStrictLoader, StrictLoader

LOADERS = (StrictLoader, FastStrictLoader)

MERGED = """
a: {b: {c: &k {<<: &z {x: 1}, x: 2}}}
d: {<<: *k, x: 3}
e: {<<: [*z, *k], y: 4}
"""


@pytest.mark.parametrize("loader", LOADERS)
def test_merge_keys_at_any_depth_are_read_as_yaml_says(loader: Any) -> None:
    """An anchor that is merged before the mapping around it is read: its own key counts before the merged one."""
    expected = {"a": {"b": {"c": {"x": 2}}}, "d": {"x": 3}, "e": {"x": 1, "y": 4}}
    assert yaml.load(MERGED, loader) == expected


@pytest.mark.parametrize("loader", LOADERS)
@pytest.mark.parametrize("text", ["[{a: {x: 1, y: 2, x: 1}}]", "a: &k {x: 1, x: 2}\nb: {<<: *k}", "{<<: {x: 1, x: 2}}"])
def test_a_key_given_twice_is_refused_wherever_it_is(loader: Any, text: str) -> None:
    with pytest.raises(yaml.YAMLError, match="the key 'x' is given twice"):
        yaml.load(text, loader)
