"""Build step that pyproject.toml cannot express: install ``schemas/`` inside the library."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SCHEMAS = [str(file) for file in sorted(Path("schemas").iterdir())]


class BuildWithSchemas(build_py):
    """Build step that copies the schemas to the first place that ``pipeline.files.schema_file`` searches."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            folder = Path(self.build_lib, "pipeline", "schemas")
            self.mkpath(str(folder))
            for file in SCHEMAS:
                self.copy_file(file, str(folder))

    def get_source_files(self) -> list[str]:
        """List the files that a source distribution must contain."""
        return [*super().get_source_files(), *SCHEMAS]


setup(cmdclass={"build_py": BuildWithSchemas})
