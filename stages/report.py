"""Stage report: one HTML page about the run, with its counts, plots, pictures and videos in it."""

from pipeline.files import write
from pipeline.run import finished
from pipeline.run.run import Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    file = run.report_file
    memory = finished.of_report(run)
    if not memory.holds():
        from pipeline.report import report
        from pipeline.testset import benchmark

        write(file, report.page(run, benchmark.load()))
        memory.keep()
    print(f"{file} ({file.stat().st_size / 1e6:.1f} MB) opens in any browser")


if __name__ == "__main__":
    main(run, __doc__)
