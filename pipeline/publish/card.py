"""The dataset card: it explains what a run's folder holds to readers who find it on the hub."""

import inspect
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import jinja2
import yaml
from huggingface_hub import DatasetCardData

from pipeline.axes import from_json
from pipeline.axes.base import LEVELS, Credit, Layer, Perturbation
from pipeline.axes.language import LanguagePerturbation, load_bank
from pipeline.clients.recipe import RECIPE
from pipeline.episode_schema import SCHEMA
from pipeline.export_config import validating
from pipeline.files import checksum, read_json, schema_file
from pipeline.formats.base import Format
from pipeline.generated import generated
from pipeline.libero.tasks import SUITES
from pipeline.publish_config import PublishConfig
from pipeline.run import manifest
from pipeline.run.counts import Counts, named, origins, tally, targets, tried
from pipeline.run.run import CARD, FINETUNE, MANIFEST, SHEETS, Run

REPORTS = ("leakage.json", "validation.json", "dataset_statistics.json")
"""What the card is made from, besides the manifest; in the run's folder."""

CHECKSUMS = "SHA256SUMS"
"""Of a repository's files, for ``sha256sum --check``."""

REPOSITORY = "OWNER/NAME"
"""Stands in a card for the repository, which is not known before the upload."""

FREE = re.compile(r"(MIT|Apache-2\.0|CC0-1\.0|CC-BY-\d)")
"""How the licences begin under which a derived work may be CC BY 4.0."""


TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("pipeline.publish"),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)

AnyFormat = Format[Any]


def write(run: Run) -> None:
    """Write ``card/<format>/`` of a run, the files next to the dataset at the root of a repository.

    Raises:
        PipelineError: when something that it describes cannot be read, or edits of the card would be lost.
    """
    rows, formats = run.manifest, run.formats
    settings = manifest.settings(run.manifest_file)
    reports = {name: read_json(run.path(name)) for name in REPORTS}
    clients = yaml.safe_load((run.path(FINETUNE) / RECIPE).read_text())["clients"]
    axes = dict.fromkeys(row["axis"] for row in rows)
    sheets = [axis for axis in axes if (run.path(SHEETS) / f"{axis}.png").is_file()]
    made_from = {name: checksum(run.path(name)) for name in (MANIFEST, *REPORTS)}
    with generated(run.path(CARD), made_from) as folder:
        for one in formats:
            (folder / one.name / "pictures").mkdir(parents=True)
            for axis in sheets:
                shutil.copyfile(run.path(SHEETS) / f"{axis}.png", folder / one.name / "pictures" / f"{axis}.png")
            others = [other.title for other in formats if other is not one]
            text = render(
                one,
                others,
                rows,
                reports,
                clients,
                sheets=sheets,
                name=run.config.export.name,
                source=settings.source,
                episodes=settings.episodes,
                publish=run.config.publish,
            )
            (folder / one.name / "README.md").write_text(text)
            sums = {one.repository_path(path): sha256 for path, sha256 in one.record().files.items()}
            sums[MANIFEST] = made_from[MANIFEST]
            lines = [f"{sha256}  {path}\n" for path, sha256 in sorted(sums.items())]
            (folder / one.name / CHECKSUMS).write_text("".join(lines))


def render(
    shown: AnyFormat,
    others: Sequence[str],
    rows: Sequence[Mapping[str, Any]],
    reports: Mapping[str, Mapping[str, Any]],
    clients: Mapping[str, Mapping[str, str]],
    *,
    sheets: Sequence[str],
    name: str,
    source: str,
    episodes: Mapping[str, int],
    publish: PublishConfig,
) -> str:
    """The card of one format, with the hub's metadata in front.

    Args:
        others: titles of the other formats.
        reports: what the files of ``REPORTS`` hold.
        clients: the section of that name in ``finetune.yaml``: where and how each policy's code is called.
        sheets: the axes that have a picture.
        source: of the demonstrations, ``starter`` or ``hdf5``.
        episodes: ``plan.episodes``, empty where the manifest does not have it.
        publish: the publisher's statements.
    """
    leakage, validation, statistics = (reports[report] for report in REPORTS)
    kept = [row for row in rows if row["kept"]]
    owed = attributions(row["perturbations"] for row in kept)
    kept_suites = named(kept, "suite")
    own_suites = [suite for suite in kept_suites if suite not in SUITES]
    own_rewrites = _own_rewrites(kept)
    libero = own_suites != kept_suites
    free = all(FREE.match(one.licence) for one in owed) and not (own_suites or own_rewrites)
    axes = _axes(kept, shown)
    demos = {row["demo_id"] for row in kept}
    of_task = Counter(demo.rpartition("/")[0] for demo in demos)
    return TEMPLATES.get_template("card.md.j2").render(
        line=lambda *cells: f"| {' | '.join(map(_cell, cells))} |",
        shown=shown,
        loading=shown.loading(name, REPOSITORY, kept),
        clients={client: call for client, call in clients.items() if client in shown.clients},
        metadata=_metadata(shown, name, publish, free=free, libero=libero).to_yaml(),
        publish=publish,
        demos=demos,
        held_out=sum(validating(shown.options.validation, number) for number in of_task.values()),
        others=" and ".join(others),
        name=name,
        kept=kept,
        origins=origins(kept, source),
        source=source,
        libero=libero,
        own_suites=own_suites,
        own_rewrites=own_rewrites,
        steps=sum(row["steps"] for row in kept),
        rows=rows,
        suites=named(rows, "suite"),
        planned=named(tried(rows), "axis"),
        counts=Counts.of,
        targets=targets(rows, episodes),
        levels=LEVELS,
        axes=axes,
        sheets=sheets,
        yields=_yields(rows),
        leakage={axis: finding for axis, finding in leakage.items() if axis in axes},
        schema=SCHEMA,
        statistics=statistics,
        validation=validation,
        failed=[check for check, found in validation.items() if found["findings"]],
        # Any will do: whoever has the dataset can try the command as it stands.
        example=min(row["episode_id"] for row in kept),
        versions=manifest.made_with(kept[0]),
        devices=sorted({row["gl_device"] for row in kept}),
        free=free,
        citation=schema_file("citation.bib").read_text(),
        owed=owed,
    )


def attributions(perturbations: Iterable[str]) -> dict[Credit, int]:
    """Everything of others' that episodes show, by kind and name, to how many of them show it.

    Args:
        perturbations: for each episode, the column of that name in the plan or the manifest. Nothing else is read.
    """
    shown = Counter(credit for text in perturbations for credit in {*chain(*(p.credits() for p in from_json(text)))})
    return dict(sorted(shown.items(), key=lambda one: (one[0].kind, *one[0])))


def _own_rewrites(kept: Iterable[Mapping[str, Any]]) -> bool:
    """Whether an instruction is a rewrite that the shipped bank does not have."""
    return any(
        isinstance(change, LanguagePerturbation)
        and change.text not in chain(*load_bank().get(row["suite"], {}).get(row["task"], {}).values())
        for row in kept
        for change in from_json(row["perturbations"])
    )


def _metadata(shown: AnyFormat, name: str, publish: PublishConfig, *, free: bool, libero: bool) -> DatasetCardData:
    licence: dict[str, Any] = {"license": "cc-by-4.0" if free else "other"}
    licence |= publish.licence_metadata()
    return DatasetCardData(
        language="en",
        pretty_name=name,
        task_categories=["robotics"],
        source_datasets=["yifengzhu-hf/LIBERO-datasets"] if libero else None,
        tags=[shown.title, "LIBERO", "LIBERO-Plus", "panda", "simulation"],
        configs=[*shown.viewer(), {"config_name": "manifest", "data_files": MANIFEST}],
        **licence,
    )


def _axes(kept: Iterable[Mapping[str, Any]], shown: AnyFormat) -> dict[str, dict[str, Any]]:
    """Axis to its kinds of change, and how many episodes show each component and level, combinations included."""
    found: dict[str, dict[str, Any]] = {}
    for row in kept:
        for change in from_json(row["perturbations"]):
            axis = found.setdefault(change.axis, {"kinds": {}, "levels": Counter()})
            what = (inspect.getdoc(type(change)) or "").partition("\n")[0]
            kind = f"{what} Changes {_changes(change, shown)}."
            axis["kinds"].setdefault(kind, Counter())[change.component] += 1
            axis["levels"][change.level] += 1
    return found


def _changes(change: Perturbation, shown: AnyFormat) -> str:
    if change.layer == Layer.TEXT:
        return "the instruction"
    views = " and ".join(f"`{shown.keys[view]}`" for view in SCHEMA.views if view in change.views)
    return f"{views}, state and length" if change.layer == Layer.PHYSICS else views


def _yields(rows: Sequence[Mapping[str, Any]]) -> list[list[object]]:
    lost = tally([row for row in tried(rows) if not row["kept"]], "reason")
    modes = tally([row for row in rows if row["kept"]], "replay_mode")
    body: list[list[object]] = []
    for axis in named(tried(rows), "axis"):
        counts = Counts.of(rows, axis=axis)
        found = (", ".join(f"{name} {count}" for name, count in one.get(axis, {}).items()) for one in (lost, modes))
        told = [text or None for text in found]
        body.append([axis, counts.planned, counts.replayed, counts.kept, f"{counts.kept / counts.planned:.0%}", *told])
    return body


def _cell(value: object) -> str:
    """Of a table in Markdown."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value).replace("|", "\\|").replace("\n", " ")
