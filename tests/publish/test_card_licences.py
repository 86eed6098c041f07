"""The card attributes everything that is shown, and claims no licence or source that it does not know."""

import json
from pathlib import Path

import pytest
from card_of_run import BACKGROUND, LAYOUT, ROWS, cells, metadata_of, row, write_files, write_rows, written
from short_demonstrations import STOVE

from pipeline.axes.background import BackgroundPerturbation
from pipeline.axes.language import LanguagePerturbation, list_rewrites


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_files(tmp_path)
    return tmp_path


def test_everything_shown_is_attributed(data: Path) -> None:
    text = written(data, "rlds")
    assert isinstance(BACKGROUND, BackgroundPerturbation)
    # The scene is a floor, which is the working surface, without a cupboard.
    shown = [covering for covering in BACKGROUND.coverings if covering.part in ("wall", "surface")]
    for covering in shown:
        assert cells(text, covering.texture, "Licences and attributions")[1] == covering.licence
    assert len(shown) == 2
    for added in LAYOUT.objects:
        assert cells(text, added.name, "Licences and attributions")[2] == added.attribution


@pytest.mark.parametrize(
    ("licence", "free"),
    [
        *(("CC-BY-3.0-US", True), ("CC0-1.0", True), ("cc-by-4.0", True), ("MIT (robosuite)", True)),
        *(("CC-BY-NC-4.0", False), ("CC-BY-SA-4.0", False), ("mine", False), ("MIT-style, no redistribution", False)),
        *(("CC-BY-4.0 NonCommercial", False), ("MIT (code only), images all rights reserved", False)),
        ("Apache-2.0 WITH Commons-Clause", False),
    ],
)
def test_a_licence_that_forbids_it_is_not_overruled(data: Path, licence: str, free: bool) -> None:
    coverings = tuple(covering.model_copy(update={"licence": licence}) for covering in BACKGROUND.coverings)
    rows = [*ROWS[:2], row("background", BACKGROUND.model_copy(update={"coverings": coverings}))]
    write_rows(data, rows)
    text = written(data, "rlds")
    assert metadata_of(text)["license"] == ("cc-by-4.0" if free else "other")
    assert ("licensed under [CC BY 4.0]" in text) == free


def test_demonstrations_of_own_tasks_are_not_attributed_to_libero(data: Path) -> None:
    own = [row(one["axis"], suite="my_suite") for one in ROWS[:1]]
    write_rows(data, own, "hdf5")
    text = written(data, "lerobot")
    metadata = metadata_of(text)
    assert metadata["license"] == "other"
    assert "source_datasets" not in metadata
    for claim in ("Liu, Zhu", "yifengzhu-hf", "human", "LIBERO demonstration", "LIBERO's wording", "[CC BY 4.0]"):
        assert claim not in text
    assert "The dataset derives from 1 recorded demonstrations of 1 tasks." in text
    assert "**Demonstrations and tasks of my_suite**: by the publisher of this dataset" in text
    # In addition to LIBERO's, both are named.
    write_rows(data, [*own, row("clean", task=STOVE)], "hdf5")
    text = written(data, "lerobot")
    metadata = metadata_of(text)
    assert metadata["license"] == "other"
    assert metadata["source_datasets"] == ["yifengzhu-hf/LIBERO-datasets"]
    assert "**Demonstrations of LIBERO's tasks**: [LIBERO]" in text
    assert "tasks of my_suite" in text


def test_only_the_starter_sets_demonstrations_are_called_human(data: Path) -> None:
    assert "2 human demonstrations of 2 tasks" in written(data, "rlds")
    write_rows(data, ROWS, "hdf5")
    text = written(data, "rlds")
    assert "2 recorded demonstrations of 2 tasks" in text
    assert "It was not checked that the publisher's files are LIBERO's own." in text
    assert metadata_of(text)["license"] == "cc-by-4.0"


@pytest.mark.parametrize("is_instruction", [True, False], ids=["an instruction", "a further wording"])
def test_rewrites_of_another_bank_are_not_licensed(is_instruction: bool, data: Path) -> None:
    shipped = list_rewrites(STOVE)[0]
    write_rows(data, [row("clean", task=STOVE), row("language", shipped, task=STOVE)])
    text = written(data, "rlds")
    assert "that generated this dataset are under MIT.\n" in text
    assert metadata_of(text)["license"] == "cc-by-4.0"
    own = LanguagePerturbation(component="paraphrase", level=1, text="please turn that stove on for me")
    if is_instruction:
        rows = [row("clean", task=STOVE), row("language", own, task=STOVE)]
    else:
        rows = [row("clean", task=STOVE) | {"rewrites": json.dumps([shipped.text, own.text])}]
    write_rows(data, rows)
    text = written(data, "rlds")
    assert "others are by\n  the publisher of this dataset, and their licence is unknown." in text
    assert metadata_of(text)["license"] == "other"
