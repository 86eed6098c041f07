"""The stages of dvc.yaml meet: what one depends on is there, or exactly one stage before it makes it."""

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml
from checkout import REPOSITORY

from pipeline import stages
from pipeline.config import load
from pipeline.formats.registry import FORMATS, GROUPS
from pipeline.run import inputs

STAGES: dict[str, dict[str, Any]] = yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())["stages"]
DATA = "${data}/${run}/"


def outputs(stage: str) -> list[str]:
    return [next(iter(entry)) for entry in (*STAGES[stage].get("outs", []), *STAGES[stage].get("metrics", []))]


def sections(stage: str) -> set[str]:
    """Of the configuration, those on which DVC starts the stage."""
    return {section for entry in STAGES[stage].get("params", []) for section in entry[DATA + "settings.json"]}


@pytest.mark.parametrize("name", STAGES)
def test_what_a_stage_depends_on_is_there_or_made_by_one_stage_before_it(name: str) -> None:
    before = list(STAGES)[: list(STAGES).index(name)]
    made = [output for earlier in before for output in outputs(earlier)]
    for needed in STAGES[name]["deps"]:
        if needed.startswith(DATA):
            assert made.count(needed) == 1, f"{needed} of {name}"
        else:
            assert (REPOSITORY / needed.replace("${run}", "starter")).exists(), f"{needed} of {name}"


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_calls_its_script_and_depends_on_it_and_on_the_library(name: str) -> None:
    assert STAGES[name]["cmd"] == f"python stages/{name}.py configs/${{run}}.yaml"
    assert {f"stages/{name}.py", "pipeline"} <= set(STAGES[name]["deps"])


def test_every_script_has_a_stage_and_no_output_lies_in_another() -> None:
    assert {file.stem for file in (REPOSITORY / "stages").glob("*.py")} == set(STAGES)
    made = [PurePosixPath(output) for stage in STAGES for output in outputs(stage)]
    assert len(made) == len(set(made))
    assert not [(one, other) for one in made for other in made if one in other.parents]


@pytest.mark.parametrize("name", ["manifest", "validate", "recipe", "card"])
def test_a_stage_that_writes_names_of_datasets_depends_on_the_options_of_every_format(name: str) -> None:
    """Such as ``dataset_statistics.json``, which names its entries by the only format that a run may have."""
    assert "export" in sections(name)


def test_previews_depend_on_the_views() -> None:
    assert "render" in sections("summary")


def test_a_run_that_goes_on_elsewhere_is_compared_first() -> None:
    assert "host" in sections("doctor")
    assert DATA + "machine.json" in STAGES["plan"]["deps"]


@pytest.mark.parametrize("file", sorted((REPOSITORY / "configs").glob("*.yaml")), ids=lambda file: file.stem)
def test_sections_of_the_configuration_are_written_out_whatever_it_leaves_out(file: Path) -> None:
    """DVC stops where a parameter is missing."""
    settings = inputs.settings(load(file))
    for stage in STAGES:
        for section in sections(stage):
            found = settings
            for field in section.split("."):
                found = found[field]


RECORDS = {f"{folder}{kind.name}.json" for kind in FORMATS for folder in ("", "failures/")}


def files(names: Iterable[str]) -> set[str]:
    """Return files of a run as DVC knows them: one file lists the records of all datasets."""
    return {"datasets.json" if name in RECORDS else name for name in names}


@pytest.mark.parametrize("name", [name for name, stage in stages.STAGES.items() if stage.outputs])
def test_dvc_knows_the_inputs_and_outputs_of_a_stage(name: str) -> None:
    """The table that `replay` shares with `render` has one stage in DVC."""
    stage = stages.STAGES[name]
    known = "exports" if name.startswith("export_") else name
    shared = {"trajectories/index.parquet"} if name == "replay" else set()
    assert {output.removeprefix(DATA) for output in outputs(known)} == files(stage.outputs) - shared
    needed = {file.removeprefix(DATA) for file in STAGES[known]["deps"] if file.startswith(DATA)}
    assert files(stage.inputs) <= needed | {"inputs.json"}


def test_the_stage_of_exports_depends_on_the_inputs_of_each_group() -> None:
    needed = {file.removeprefix(DATA) for file in STAGES["exports"]["deps"]}
    exports = [stages.STAGES[f"export_{group}"] for group in GROUPS]
    assert {file for stage in exports for file in stage.inputs} <= needed
    sections_of_groups = {section for stage in exports for section in stage.settings}
    assert sections_of_groups == {section.partition(".")[0] for section in sections("exports")}


def test_the_card_is_generated_again_after_every_change_that_it_records() -> None:
    assert sections("card") == {*inputs.PUBLISHED} == {*stages.STAGES["card"].settings}


def test_the_report_is_generated_again_after_every_change_that_it_shows() -> None:
    """It has the configuration of the run, and states nothing about publication."""
    assert sections("report") == {*inputs.PUBLISHED} - {"publish"}


def test_params_name_the_shipped_default() -> None:
    assert yaml.safe_load((REPOSITORY / "params.yaml").read_text()) == {"run": "starter", "data": "data"}
