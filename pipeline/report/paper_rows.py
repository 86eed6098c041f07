"""The paper's table as Markdown, CSV and LaTeX rows, with equal numbers."""

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.errors import PipelineError
from pipeline.outputs import reject_other_file, write
from pipeline.report.paper_table import DIMENSIONS

HEADINGS = (*DIMENSIONS, "total", "mean of seven")
"""Headings of the rates."""

SUITES = {"libero_spatial": "spatial", "libero_object": "object", "libero_goal": "goal", "libero_10": "long"}
"""Suite to its short name in the paper's order."""

NOT_STATED = "not stated"

SUFFIXES = (".md", ".csv", ".tex")
"""Suffixes of the files of a table."""

LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "|": r"\textbar{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    **{character: f"\\{character}" for character in "&%$#_"},
}
"""Character to its LaTeX command, for characters that LaTeX does not print as they are."""

MARKUP = re.compile(r"[\\`*<|~\[]|&(?=[#\w])|(?<![^\W_])_|_(?![^\W_])")
"""Characters that Markdown does not print as they are; an underscore inside a word is printed."""


class ModelRow(NamedTuple):
    """One model's row, with each number as all formats print it.

    Attributes:
        black: views that were black.
        mixed_versions: names and versions, where the episodes have several.
        rates: heading to the rate in percent; `None` if it was not measured.
        intervals: heading to the bounds of the 95 % interval in percent, of measured rates.
        partial: headings whose rate leaves out a part of the benchmark.
        sampled: heading of any other estimate from some of the test tasks, to their number in words.
        tasks_run: heading of a column, or ``total``, to the number of test tasks with an episode.
        absent: column to the left-out parts.
    """

    name: str
    published: bool
    program: str
    prompt: str
    step_limits: str
    trials: str
    left_out: int
    black: str
    mixed_versions: str
    rates: Mapping[str, str | None]
    intervals: Mapping[str, tuple[str, str]]
    partial: frozenset[str]
    sampled: Mapping[str, str]
    tasks_run: Mapping[str, int]
    absent: Mapping[str, str]


def rows_of(table: Mapping[str, Any]) -> list[ModelRow]:
    """Return the rows of a table: evaluated policies, then published models.

    Args:
        table: the result of ``table_of``.
    """
    return [
        *(_evaluated(row, table["tasks"]) for row in table["evaluated"]),
        *(_published(row, table) for row in table["published"]),
    ]


def _evaluated(row: Mapping[str, Any], sizes: Mapping[str, int]) -> ModelRow:
    """Return the row of an evaluated policy.

    Args:
        sizes: column to the number of its test tasks.
    """
    cells, protocol = row["cells"], row["protocol"]
    estimates = {**cells, "total": row["total"], "mean of seven": row["mean"]}
    measured = {heading: estimate for heading, estimate in estimates.items() if estimate is not None}
    absent = {column: cell["absent"] for column, cell in cells.items() if cell["absent"]}
    tasks_run = {column: cells[column]["tasks"] if column in cells else 0 for column in DIMENSIONS}
    partial = frozenset([*absent, "total", "mean of seven"] if absent else ())
    counts = {**tasks_run, "total": sum(tasks_run.values())}
    whole = {**sizes, "total": sum(sizes.values())}
    sampled: dict[str, str] = {}
    for heading in HEADINGS:
        counted = heading if heading in counts else "total"  # The mean of seven is over all tasks, too.
        if heading in measured and heading not in partial and counts[counted] < whole[counted]:
            sampled[heading] = f"{counts[counted]:,} of {whole[counted]:,}"
    fewest, most = protocol["trials"]
    return ModelRow(
        name=row["name"],
        published=False,
        program=protocol["program"],
        prompt=protocol["prompt"] or NOT_STATED,
        step_limits=_limits(protocol["step_limits"]),
        trials=str(fewest) if fewest == most else f"{fewest} to {most}",
        left_out=protocol["left_out"],
        black=protocol["black"],
        mixed_versions=", ".join(f"{name} {' and '.join(found)}" for name, found in protocol["mixed_versions"].items()),
        rates={heading: _percent(measured[heading]["rate"]) if heading in measured else None for heading in HEADINGS},
        intervals={
            heading: (_percent(estimate["low"]), _percent(estimate["high"])) for heading, estimate in measured.items()
        },
        partial=partial,
        sampled=sampled,
        tasks_run=counts,
        absent=absent,
    )


def _published(row: Mapping[str, Any], table: Mapping[str, Any]) -> ModelRow:
    """Return the row of a published model, whose rates are in percent."""
    protocol = table["protocol"]
    rates = {**row["rates"], "total": row["total"], "mean of seven": row["mean"]}
    return ModelRow(
        name=row["name"],
        published=True,
        program=table["source"],
        prompt=protocol["prompt"],
        step_limits=protocol["step_limits"],
        trials=str(protocol["trials"]),
        left_out=0,
        black="none",
        mixed_versions="",
        rates={heading: f"{rates[heading]:.1f}" for heading in HEADINGS},
        intervals={},
        partial=frozenset(),
        sampled={},
        tasks_run={**table["tasks"], "total": protocol["tasks_run"]},
        absent={},
    )


def _percent(rate: float) -> str:
    """Return a rate in [0, 1] as percent."""
    return f"{100 * rate:.1f}"


def _limits(limits: Mapping[str, Sequence[int]]) -> str:
    """Describe the step limits of the suites that were run."""
    if not limits:
        return NOT_STATED
    parts = []
    for suite in sorted(limits, key=list(SUITES).index):
        parts.append(f"{SUITES[suite]} {' or '.join(map(str, limits[suite]))}")
    return ", ".join(parts)


def markdown(table: Mapping[str, Any]) -> str:
    """Return the table as Markdown, with the protocol of each evaluated policy and the left-out parts."""
    lines = [f"| model | {' | '.join(HEADINGS)} |", f"|---|{'---:|' * len(HEADINGS)}"]
    rows = rows_of(table)
    sizes = {**table["tasks"], "total": sum(table["tasks"].values())}
    for row in rows:
        cells = [_marked(row, heading, "*", "†") or "-" for heading in HEADINGS]
        lines.append(_line(f"{row.name} (published)" if row.published else row.name, cells))
        if not row.published:
            bounds = [" to ".join(row.intervals[name]) if name in row.intervals else "" for name in HEADINGS]
            lines.append(_line(f"{row.name}, 95 % interval", bounds))
            counts = [f"{row.tasks_run[name]:,} of {sizes[name]:,}" if name in sizes else "" for name in HEADINGS]
            lines.append(_line(f"{row.name}, tasks run", counts))
    lines.append("")
    for row in rows:
        lines += _notes(row)
    protocol = table["protocol"]
    lines.append(
        f"- Published ({table['source']}): {protocol['tasks_run']:,} tasks; {protocol['trials']} trial per task; "
        f"prompt {protocol['prompt']}; step limits {protocol['step_limits']}; the mean of seven is computed from the "
        "columns."
    )
    return "\n".join(lines) + "\n"


def _line(name: str, cells: Sequence[str]) -> str:
    """Return a line of a Markdown table."""
    return f"| {' | '.join([_escaped(name), *cells])} |"


def _escaped(name: str) -> str:
    """Return a name as Markdown text in one line."""
    return MARKUP.sub(r"\\\g<0>", " ".join(name.split()))


def _marked(row: ModelRow, heading: str, star: str, dagger: str) -> str:
    """Return a rate, empty if it was not measured.

    A star marks a rate without a part of the benchmark, a dagger another estimate from some of the test tasks.
    """
    rate = row.rates[heading]
    if rate is None:
        return ""
    if heading in row.partial:
        return rate + star
    return rate + dagger if heading in row.sampled else rate


def _notes(row: ModelRow) -> Iterator[str]:
    """Yield the protocol of an evaluated policy and its left-out parts, each as a line of a Markdown list."""
    if row.published:
        return
    name = _escaped(row.name)
    yield f"- {name}: {_protocol(row)}."
    for column, parts in row.absent.items():
        yield f"- \\* {name}, {column}: without {parts}."
    if row.sampled:
        yield f"- † {name}: estimated from some of the tasks, {_sampled(row)}."


def _sampled(row: ModelRow) -> str:
    return ", ".join(f"{heading} {count}" for heading, count in row.sampled.items())


def _protocol(row: ModelRow) -> str:
    """Describe the protocol of an evaluated policy."""
    trials = "trial" if row.trials == "1" else "trials"
    black = "" if row.black == "none" else f"; black views {row.black}"
    versions = f"; several versions: {row.mixed_versions}" if row.mixed_versions else ""
    left_out = f"; {row.left_out:,} episodes without a result are left out" if row.left_out else ""
    return (
        f"{row.tasks_run['total']:,} tasks; {row.trials} {trials} per task; prompt {row.prompt}; step limits "
        f"{row.step_limits}{black}; run by {row.program}{versions}{left_out}"
    )


def csv_text(table: Mapping[str, Any]) -> str:
    """Return the table as CSV, one line for each model; cells that were not measured are empty."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    named = {heading: heading.replace(" ", "_") for heading in HEADINGS}
    counted = (*DIMENSIONS, "total")
    writer.writerow(
        [
            "model",
            "published",
            "program",
            "prompt",
            "step_limits",
            "trials_per_task",
            "episodes_left_out",
            "black_views",
            "mixed_versions",
            *named.values(),
            *(f"{name}_tasks_run" for name in counted),
            *(f"{name}_{bound}" for name in named.values() for bound in ("low", "high")),
            "left_out_parts",
        ]
    )
    for row in rows_of(table):
        bounds: list[str] = []
        for heading in HEADINGS:
            bounds += row.intervals.get(heading, ("", ""))
        writer.writerow(
            [
                row.name,
                "yes" if row.published else "no",
                row.program,
                row.prompt,
                row.step_limits,
                row.trials,
                row.left_out,
                row.black,
                row.mixed_versions,
                *(row.rates[heading] or "" for heading in HEADINGS),
                *(row.tasks_run[name] for name in counted),
                *bounds,
                "; ".join(f"{column}: {parts}" for column, parts in row.absent.items()),
            ]
        )
    return output.getvalue()


def latex(table: Mapping[str, Any]) -> str:
    """Return a LaTeX row of each evaluated policy, for a ``tabular`` with ten columns; comments state the protocol."""
    lines = [f"% model & {' & '.join(HEADINGS)} \\\\"]
    for row in rows_of(table):
        if row.published:
            continue
        cells = [_marked(row, heading, "$^{*}$", r"$^{\dagger}$") or "--" for heading in HEADINGS]
        name = "".join(LATEX.get(character, character) for character in " ".join(row.name.split()))
        # After the end of the line before, `[` and `*` would begin an option of that end.
        name = f"{{}}{name}" if name.startswith(("[", "*")) else name
        lines.append(f"% {_protocol(row)}")
        lines += [f"% * {column}: without {parts}" for column, parts in row.absent.items()]
        if row.sampled:
            lines.append(f"% dagger: estimated from some of the tasks, {_sampled(row)}")
        lines.append(f"{' & '.join([name, *cells])} \\\\")
    return "\n".join(lines) + "\n"


def write_table(table: Mapping[str, Any], path: Path) -> list[Path]:
    """Write the table as Markdown, CSV and LaTeX.

    Args:
        path: path of the three files without their suffix.

    Returns:
        The three files.

    Raises:
        PipelineError: if a file would overwrite a file of another origin.
    """
    reject_other_tables(path)
    texts = {".md": markdown(table), ".csv": csv_text(table), ".tex": latex(table)}
    written = []
    for suffix, text in texts.items():
        file = path.with_name(path.name + suffix)
        write(file, text)
        written.append(file)
    return written


def reject_other_tables(path: Path) -> None:
    """Reject files that ``write_table`` would overwrite but has not written.

    Args:
        path: path of the three files without their suffix.

    Raises:
        PipelineError: if a file is rejected, or if the path has no name of a file; it names the path.
    """
    if path.name in ("", ".."):
        raise PipelineError("the path has no name for the files", where=path, expected="a name such as tables/mine")
    for suffix in SUFFIXES:
        reject_other_file(path.with_name(path.name + suffix))
