"""Stage manifest: one row for every planned episode, the statistics for OpenVLA-OFT, and the counts."""

from pipeline.files import write_json
from pipeline.formats import exact_statistics, registry
from pipeline.formats.episodes import by_suite
from pipeline.run import counts, manifest
from pipeline.run.run import COUNTS, STATISTICS, Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    config, outcome = run.config, run.outcome
    table = manifest.build(outcome, registry.places(run.formats), registry.columns(), config.export.where)
    manifest.write(table, run.manifest_file, manifest.Settings.of(config))

    row_of = outcome.row_of
    trajectory_of = {episode_id: row_of[episode_id].trajectory_id for episode_id in outcome.kept}
    motions = {name: run.frames.motion(name) for name in {*trajectory_of.values()}}
    suites = {episode_id: row_of[episode_id].suite for episode_id in outcome.kept}
    figures = {}
    for name, members in by_suite(suites, (config.export.rlds or config.export).name).items():
        figures[name] = exact_statistics.openvla([motions[trajectory_of[episode_id]] for episode_id in members])
    write_json(run.path(STATISTICS), figures)
    write_json(run.path(COUNTS), counts.by_axis_and_suite(table.to_pylist()))


if __name__ == "__main__":
    main(run, __doc__)
