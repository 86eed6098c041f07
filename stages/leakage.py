"""Stage leakage, as DVC calls it; ``pipeline/stages.py`` has its function."""

from pipeline.stages import script

if __name__ == "__main__":
    script("leakage")
