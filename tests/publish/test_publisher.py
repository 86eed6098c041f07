"""The publisher's licence, author and notes come from the configuration, and the card says so."""

from pathlib import Path

import pytest
from card_of_run import metadata_of, row, write_files, write_rows, written
from pydantic import ValidationError
from short_demonstrations import STOVE

from pipeline.publish_config import PublishConfig


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_files(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("stated", "metadata"),
    [
        ("CC-BY-NC-4.0", {"license": "cc-by-nc-4.0"}),
        ("odbl", {"license": "odbl"}),
        ("other", {"license": "other"}),
        (
            "etalab-2.0",
            {"license": "etalab-2.0"},
        ),
        (
            "gpl-3.0-only",
            {
                "license": "other",
                "license_name": "gpl-3.0-only",
                "license_link": "https://spdx.org/licenses/GPL-3.0-only.html",
            },
        ),
    ],
)
def test_the_hub_reads_the_stated_licence(data: Path, stated: str, metadata: dict[str, str]) -> None:
    text = written(data, "rlds", publish=PublishConfig(licence=stated))
    found = metadata_of(text)
    assert {name: found[name] for name in found if name.startswith("license")} == metadata


@pytest.mark.parametrize("stated", ["", "mine", "MIT OR Apache-2.0", "LicenseRef-mine", "CC BY 4.0", "cc-by"])
def test_other_words_are_no_licence(stated: str) -> None:
    with pytest.raises(ValidationError, match=r"SPDX identifier, such as CC-BY-NC-4\.0"):
        PublishConfig(licence=stated)


def test_what_is_stated_is_shown_with_its_source(data: Path) -> None:
    default = written(data, "rlds")
    assert "publish" not in default.partition("## Licences and attributions")[2]
    publish = PublishConfig(
        licence="CC-BY-4.0", author="Jane Doe, Some Lab", notes="Recorded **twice**.\n\nThen cut.\n"
    )
    text = written(data, "rlds", publish=publish)
    notes = text.partition("## Notes of the publisher")[2].partition("##")[0]
    assert "Recorded **twice**.\n\nThen cut.\n" in notes
    assert "`publish.notes`" in notes
    licences = text.partition("## Licences and attributions")[2]
    for words in ("**cc-by-4.0**", "`publish.licence`", "did not check it", "Jane Doe, Some Lab", "`publish.author`"):
        assert words in licences
    assert "is licensed under" not in licences


def test_a_stated_licence_hides_no_restriction_of_a_source(data: Path) -> None:
    write_rows(data, [row("clean", task=STOVE) | {"suite": "my_suite", "demo_id": "my_suite/x/demo_0"}], "hdf5")
    text = written(data, "rlds", publish=PublishConfig(licence="MIT", author="Jane Doe"))
    assert metadata_of(text)["license"] == "mit"
    assert "Some sources of the dataset have licences that are unknown, or that do not allow" in text
    assert "**Demonstrations and tasks of my_suite**: by Jane Doe; the publisher states only the licence above." in text
    unstated = written(data, "rlds")
    assert (
        "**Demonstrations and tasks of my_suite**: by the publisher of this dataset; their licence is unknown."
        in unstated
    )
