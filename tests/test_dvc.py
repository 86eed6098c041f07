"""The stages of dvc.yaml meet: what one depends on is there, or exactly one stage before it makes it."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import pytest
import yaml
from conftest import REPOSITORY

from pipeline.config import Config

STAGES: dict[str, dict[str, Any]] = yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())["stages"]
DATA = "data/${run}/"


def outputs(stage: str) -> list[str]:
    return [next(iter(entry)) for entry in (*STAGES[stage].get("outs", []), *STAGES[stage].get("metrics", []))]


def sections(stage: str) -> set[str]:
    """Of the configuration, those on which DVC starts the stage."""
    return {section for entry in STAGES[stage].get("params", []) for section in entry["configs/${run}.yaml"]}


@pytest.mark.parametrize("name", STAGES)
def test_what_a_stage_depends_on_is_there_or_made_by_one_stage_before_it(name: str) -> None:
    before = list(STAGES)[: list(STAGES).index(name)]
    made = [output for earlier in before for output in outputs(earlier)]
    for needed in STAGES[name]["deps"]:
        if needed.startswith(DATA):
            assert made.count(needed) == 1, f"{needed} of {name}"
        else:
            assert (REPOSITORY / needed).exists(), f"{needed} of {name}"


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_calls_its_script_and_depends_on_it_and_on_the_library(name: str) -> None:
    assert STAGES[name]["cmd"] == f"python stages/{name}.py configs/${{run}}.yaml"
    assert {f"stages/{name}.py", "pipeline"} <= set(STAGES[name]["deps"])


def test_every_script_has_a_stage_and_no_output_lies_in_another() -> None:
    assert {file.stem for file in (REPOSITORY / "stages").glob("*.py")} == set(STAGES)
    made = [PurePosixPath(output) for stage in STAGES for output in outputs(stage)]
    assert len(made) == len(set(made))
    assert not [(one, other) for one in made for other in made if one in other.parents]


def test_sections_of_the_configuration_exist() -> None:
    for stage in STAGES:
        for section in sections(stage):
            kind: Any = Config
            for field in section.split("."):
                kind = kind.model_fields[field].annotation
