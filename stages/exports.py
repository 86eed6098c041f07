"""Stages export_<group>, as DVC calls them; ``pipeline/stages.py`` has a stage for each group of formats."""

from pipeline.stage_script import perform_stage

if __name__ == "__main__":
    perform_stage("exports")
