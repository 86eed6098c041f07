"""Stage leakage: compare every planned perturbation with the benchmark's test tasks, and stop where one overlaps."""

from rich.console import Console

from pipeline.planning import leakage
from pipeline.run.run import LEAKAGE, Run
from pipeline.run.stage import main
from pipeline.testset import benchmark


def run(run: Run) -> None:
    findings = leakage.check(run.plan, benchmark.load())
    leakage.write(findings, run.path(LEAKAGE))
    Console().print(leakage.report(findings))
    leakage.refuse_overlap(findings)


if __name__ == "__main__":
    main(run, __doc__)
