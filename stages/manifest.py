"""Stage manifest: one row for every planned episode, the statistics for OpenVLA-OFT, and the counts."""

from pipeline.config import Config
from pipeline.files import write_json
from pipeline.formats import exact_statistics, registry
from pipeline.formats.episodes import by_suite
from pipeline.run import counts, manifest, outcome
from pipeline.run.stage import main
from pipeline.stores.frame_store import FrameStore


def run(config: Config) -> None:
    data = config.data
    episodes = outcome.read(config)
    table = manifest.build(
        episodes,
        places=registry.places(registry.formats_of(data, config.export, config.render.extras)),
        columns=registry.columns(),
        where=config.export.where,
    )
    manifest.write(table, data / "manifest.parquet", manifest.Settings.of(config))

    frames, row_of = FrameStore(data / "frames", config.render), episodes.row_of
    motions = {name: frames.motion(name) for name in {row_of[episode].trajectory_id for episode in episodes.kept}}
    suites = {episode: row_of[episode].suite for episode in episodes.kept}
    name = (config.export.rlds or config.export).name
    figures = {
        name: exact_statistics.openvla([motions[row_of[episode].trajectory_id] for episode in members])
        for name, members in by_suite(suites, name).items()
    }
    write_json(data / "dataset_statistics.json", figures)
    write_json(data / "counts.json", counts.by_axis_and_suite(table.to_pylist()))


if __name__ == "__main__":
    main(run, __doc__)
