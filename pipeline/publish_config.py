"""The configuration's section ``publish``: licence, author and notes of the dataset card."""

from __future__ import annotations

from typing import Annotated

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression
from pydantic import AfterValidator, Field

from pipeline.types import Frozen

HUB_LICENCES = frozenset(
    (
        *("apache-2.0", "mit", "openrail", "bigscience-openrail-m", "creativeml-openrail-m"),
        *("bigscience-bloom-rail-1.0", "bigcode-openrail-m", "afl-3.0", "artistic-2.0", "bsl-1.0", "bsd"),
        *("bsd-2-clause", "bsd-3-clause", "bsd-3-clause-clear", "c-uda", "cc", "cc0-1.0", "cc-by-2.0", "cc-by-2.5"),
        *("cc-by-3.0", "cc-by-4.0", "cc-by-sa-3.0", "cc-by-sa-4.0", "cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0"),
        *("cc-by-nd-4.0", "cc-by-nc-nd-3.0", "cc-by-nc-nd-4.0", "cc-by-nc-sa-2.0", "cc-by-nc-sa-3.0"),
        *("cc-by-nc-sa-4.0", "cdla-sharing-1.0", "cdla-permissive-1.0", "cdla-permissive-2.0", "wtfpl", "ecl-2.0"),
        *("epl-1.0", "epl-2.0", "etalab-2.0", "eupl-1.1", "agpl-3.0", "gfdl", "gpl", "gpl-2.0", "gpl-3.0", "lgpl"),
        *("lgpl-2.1", "lgpl-3.0", "isc", "lppl-1.3c", "ms-pl", "mpl-2.0", "odc-by", "odbl", "openrail++", "osl-3.0"),
        *("postgresql", "ofl-1.1", "ncsa", "unlicense", "zlib", "pddl", "lgpl-lr", "deepfloyd-if-license", "llama2"),
        *("gemma", "unknown", "other"),
    )
)
"""Names that the hub accepts in a card's field ``license`` (https://huggingface.co/docs/hub/repositories-licenses)."""


def _known_licence(name: str) -> str:
    """Return the hub's name in small letters, else the SPDX identifier in its own spelling."""
    if name.lower() in HUB_LICENCES:
        return name.lower()
    try:
        spdx = str(canonicalize_license_expression(name))
    except InvalidLicenseExpression:
        spdx = ""
    if not spdx or " " in spdx or spdx.startswith("LicenseRef-"):
        raise ValueError(
            "expected one SPDX identifier, such as CC-BY-NC-4.0 (https://spdx.org/licenses), or a name of "
            "https://huggingface.co/docs/hub/repositories-licenses, such as `other`, which notes can explain"
        )
    return spdx


Licence = Annotated[str, AfterValidator(_known_licence)]


class PublishConfig(Frozen):
    """Statements of the publisher in the dataset card; none by default.

    Attributes:
        licence: Licence of the whole dataset: an SPDX identifier, or the hub's name of a licence. The default is
            derived from the licences of the demonstrations, textures and objects in the dataset.
        author: Publisher of the dataset, in one line of at most 500 characters; none by default.
        notes: Further section of the card, in Markdown, with at most 20,000 characters; none by default.
    """

    licence: Licence | None = None
    author: str | None = Field(default=None, min_length=1, max_length=500, pattern=r"^[^\r\n]+$")
    notes: str | None = Field(default=None, min_length=1, max_length=20_000)

    def licence_metadata(self) -> dict[str, str]:
        """Return the fields of the card's metadata for the stated licence; empty without one."""
        if self.licence is None:
            return {}
        if self.licence in HUB_LICENCES:
            return {"license": self.licence}
        link = f"https://spdx.org/licenses/{self.licence}.html"
        return {"license": "other", "license_name": self.licence.lower(), "license_link": link}
