"""Stage report: one HTML page about the run, with its counts, plots, pictures and videos in it."""

from pipeline.config import Config
from pipeline.publish import pages, report
from pipeline.run.stage import main
from pipeline.testset import benchmark


def run(config: Config) -> None:
    file = config.data / report.FILE
    pages.write(report.page(config, benchmark.load()), file)
    print(f"wrote {file} ({file.stat().st_size / 1e6:.1f} MB), which opens in any browser")


if __name__ == "__main__":
    main(run, __doc__)
