"""Stage leakage, as DVC calls it; ``pipeline/stages.py`` has its function."""

from pipeline.stage_script import perform_stage

if __name__ == "__main__":
    perform_stage("leakage")
