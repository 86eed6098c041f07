"""What a person's YAML is read as: keys, merge keys, numbers and booleans."""

from typing import Any

import pytest
import yaml
from checkout import REPOSITORY
from pydantic import ValidationError
from ruamel.yaml import YAML

from pipeline.config import Config
from pipeline.strict_yaml import FastStrictLoader, StrictLoader, dump

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
def test_a_key_given_twice_is_rejected_wherever_it_is(loader: Any, text: str) -> None:
    with pytest.raises(yaml.YAMLError, match="the key 'x' is repeated"):
        yaml.load(text, loader)


def test_written_values_are_read_again() -> None:
    texts = [
        "1e5",
        "1.5e3",
        ".5e3",
        "-.5",
        "1e-05",
        "12e4567",
        "yes",
        "1:30",
        "0123",
        "null",
        "",
        "a: b",
        "# c",
        "true",
    ]
    content = {
        "texts": texts,
        "numbers": [1, 1e-05, 0.5, -3, True, None],
        "nested": {"folder": "1e5", "list": [{}, []]},
    }
    assert yaml.load(dump(content), StrictLoader) == content


SCALARS = (
    "true True FALSE yes no on off y 0 1 -1 +1 1:30 12:00:00 1e3 1e-3 1.5e+3 1. .5 -.5 .inf null Null ~ 1.2.3 - e1"
)


def test_plain_values_are_those_that_dvc_reads() -> None:
    """DVC reads parameters with ruamel.yaml, as YAML 1.2 says: other values would not start its stages."""
    for text in SCALARS.split():
        found = yaml.load(text, StrictLoader)
        assert repr(found) == repr(YAML(typ="safe").load(text)), text
    for file in (*REPOSITORY.glob("configs/*.yaml"), REPOSITORY / "params.yaml"):
        text = file.read_text()
        assert yaml.load(text, StrictLoader) == YAML(typ="safe").load(text) == yaml.safe_load(text), file


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("plan: {episodes: {camera: yes}}", "episodes"),
        ("plan: {episodes: {camera: 1:30}}", "episodes"),
        ("plan: {episodes: {camera: 1}, seed: on}", "seed"),
        ("filter: {non_target_moved_m: off}", "non_target_moved_m"),
    ],
)
def test_a_word_or_a_time_is_no_number(text: str, field: str) -> None:
    read = {"name": "mine", "plan": {"episodes": {"camera": 1}}} | yaml.load(text, StrictLoader)
    with pytest.raises(ValidationError, match=field):
        Config.model_validate(read)


def test_booleans_where_they_belong_and_a_number_with_a_leading_zero() -> None:
    text = "{name: mine, plan: {seed: 0123, episodes: {camera: 1}}, export: {failures: true}}"
    config = Config.model_validate(yaml.load(text, StrictLoader))
    assert config.export.failures
    assert config.plan.seed == 123
