"""The report of evaluations: one HTML page in need of nothing beside itself, and what it says as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.errors import PipelineError
from pipeline.evaluation.results import Evaluated
from pipeline.evaluation.statistics import FEW, RESAMPLES, SAMPLE, wilson
from pipeline.files import replaced
from pipeline.report import figures, pages
from pipeline.report.evaluation_findings import FAILURES, findings
from pipeline.report.figures import Panel, Share
from pipeline.report.yields import Cell, Table

TITLES = {
    "libero_plus": "LIBERO-Plus's test tasks",
    "own": "Held-out draws of this project's axes",
    "goals": "Other goals in LIBERO's scenes",
    "libero": "LIBERO's tasks, unperturbed",
}
"""Of sources of tasks; others have their own names as titles."""

GROUPINGS = {
    "by_axis": "by axis",
    "by_axis_and_component": "by component",
    "by_level": "by level",
    "by_suite": "by suite",
}
CLOSER = {"by_axis_and_level": "by axis and level", "by_suite_and_axis": "by suite and axis"}
"""Groupings of ``summary`` to their titles; those of ``CLOSER`` are folded away and not plotted."""


WIDE = 0.2
"""A rate whose interval is wider is not set beside published ones: the interval stands in its place."""


class Section(NamedTuple):
    """Results on the tasks of one source: rates with their intervals as plots and in numbers, and comparisons."""

    title: str
    alike: str
    panels: list[Panel]
    tables: list[Table]
    closer: list[Table]
    comparisons: list[Table]


def write(policies: Sequence[Evaluated], path: Path) -> dict[str, Any]:
    """Write the page, and its findings beside it.

    Returns:
        Where they are, and each policy's rate by source.

    Raises:
        PipelineError: when ``path`` is not one of an HTML file.
    """
    if path.suffix != ".html":
        raise PipelineError("not the name of a page", where=path, expected="a name that ends in .html")
    found = findings(policies)
    pages.write(page(found, {episode: file for policy in policies for episode, file in policy.videos.items()}), path)
    beside = path.with_suffix(".json")
    with replaced(beside) as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
    rates = {
        name: {source: one["all"] for source, one in policy["results"].items()}
        for name, policy in found["policies"].items()
    }
    return {"page": str(path), "findings": str(beside), "rates": rates}


def page(found: Mapping[str, Any], videos: Mapping[str, Path]) -> str:
    """The page.

    Args:
        found: from ``findings``.
        videos: by the name of the episode.
    """
    policies = found["policies"]
    colours = dict(zip(policies, cycle(figures.COLOURS.values()), strict=False))
    paper = found["paper_table"]
    return pages.render(
        "evaluation_report.html.j2",
        colours=colours,
        overall={name: policy["overall"] for name, policy in policies.items()},
        by_source=_by_source(found),
        refused=sum(policy["refused"] for policy in policies.values()),
        paper=paper,
        differ=_differ(found),
        published_points=_points(paper["tasks"]) if paper else None,
        wide=WIDE,
        resamples=RESAMPLES,
        sample=SAMPLE,
        few=FEW,
        sections=[_section(source, found, colours) for source in found["common"]],
        failures=[
            {**failure, "video": pages.video_of(videos[failure["episode"]]) if failure["video"] else None}
            for failure in found["failures"]
        ],
        limit=FAILURES,
        titles=TITLES,
        made_with={name: _made_with(policy) for name, policy in policies.items()},
    )


def _by_source(found: Mapping[str, Any]) -> Table | None:
    """Each policy's rate on each source; None where there is one source, whose rate is the overall one."""
    sources = list(found["common"])
    if len(sources) < 2:
        return None
    rows = [
        (Cell(name), *(_rate(policy["results"].get(source, {}).get("all")) for source in sources))
        for name, policy in found["policies"].items()
    ]
    return Table("By source of the tasks", ("", *(TITLES.get(source, source) for source in sources)), rows)


def _differ(found: Mapping[str, Any]) -> bool:
    """Whether some policy ran episodes that another did not."""
    policies = found["policies"].values()
    return any(
        policy["results"].get(source, {"all": {"episodes": 0}})["all"]["episodes"] != common
        for source, common in found["common"].items()
        for policy in policies
    )


def _points(tasks: Mapping[str, int]) -> tuple[float, float]:
    """How wide intervals of published rates are at most, in points: of the total, and of the smallest column."""

    def widest(count: int) -> float:
        low, high = wilson(count / 2, count)
        return 100 * (high - low)

    return widest(sum(tasks.values())), widest(min(tasks.values()))


def _section(source: str, found: Mapping[str, Any], colours: Mapping[str, str]) -> Section:
    results = {
        name: policy["results"][source] for name, policy in found["policies"].items() if source in policy["results"]
    }

    def names(grouping: str) -> list[str]:
        return sorted({name for one in results.values() for name in one[grouping]})

    def table(grouping: str, title: str) -> Table:
        return Table(
            title,
            ("", *results),
            [
                (Cell(name.replace("_", " ")), *(_rate(one[grouping].get(name)) for one in results.values()))
                for name in names(grouping)
            ],
        )

    def plot(grouping: str, title: str) -> Panel:
        rows: dict[str, list[Share]] = {name: [] for name in names(grouping)}
        for policy, one in results.items():
            for name, group in one[grouping].items():
                rows[name].append(Share(group["rate"], group["low"], group["high"], colours[policy]))
        return figures.intervals(title, rows, "success rate")

    # Where a grouping has one group, it repeats the whole, which stands at the top of the page.
    several = [grouping for grouping in (*GROUPINGS, *CLOSER) if len(names(grouping)) > 1]
    shown = {grouping: title for grouping, title in GROUPINGS.items() if grouping in several}
    return Section(
        TITLES.get(source, source),
        _alike([one["all"]["episodes"] for one in results.values()], found["common"][source]),
        [plot(grouping, title) for grouping, title in shown.items()],
        [table(grouping, title) for grouping, title in shown.items()],
        [table(grouping, title) for grouping, title in CLOSER.items() if grouping in several],
        [_comparison(one) for one in found["comparisons"] if one["source"] == source],
    )


def _rate(group: Mapping[str, Any] | None) -> Cell:
    if group is None:
        return Cell("-")
    interval = f"{100 * group['low']:.0f} to {100 * group['high']:.0f}"
    return Cell(
        f"{100 * group['rate']:.1f} % ({interval}), {group['successes']:,}/{group['episodes']:,}", group["rate"]
    )


def _alike(episodes: Sequence[int], common: int) -> str:
    """Whether the policies ran the same episodes."""
    if len(episodes) < 2:
        return ""
    if set(episodes) == {common}:
        return f"All policies ran the same {pages.counted(common, 'episode')}."
    return (
        f"The policies did not run the same episodes: {common:,} are common to all. Each column has all of its own "
        "policy's; the comparisons have the common ones of two."
    )


def _comparison(one: Mapping[str, Any]) -> Table:
    lines = {**({"all": one["all"]} if len(one["by_axis"]) > 1 else {}), **one["by_axis"]}
    counts = ("episodes", "both", "only_first", "only_second", "neither")
    return Table(
        f"{one['first']} (first) and {one['second']} (second)",
        (
            *("", *(name.replace("_", " ") for name in counts)),
            *("second minus first", "p", "McNemar's p", "drawn anew"),
        ),
        [
            (
                Cell(name),
                *(Cell(f"{line[key]:,}") for key in counts),
                Cell(_difference(line["difference"])),
                *(Cell("-" if p is None else f"{p:.2g}") for p in (line["difference"]["p_value"], line["p_value"])),
                Cell(line["difference"]["resampled"]),
            )
            for name, line in lines.items()
        ],
    )


def _difference(found: Mapping[str, Any]) -> str:
    value = f"{100 * found['value']:+.1f}"
    return value if found["low"] is None else f"{value} ({100 * found['low']:+.0f} to {100 * found['high']:+.0f})"


def _made_with(policy: Mapping[str, Any]) -> dict[str, str]:
    settings = {name.replace("_", " "): str(value) for name, value in policy["settings"].items()}
    return {**settings, **{name: "; ".join(values) for name, values in policy["versions"].items()}}
