"""Hook of MkDocs: the pages of the site are the Markdown files of the repository, under the same paths."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

REPOSITORY = Path(__file__).parents[2]
PATTERNS = ("*.md", "docs/*.md", "docs/*.jpg", "docs/*.svg", "benchmarks/*.md", "sbom.json", "LICENSE", "CITATION.cff")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace the files of ``docs_dir`` by those of the repository; files of the theme stay."""
    pages = [file for file in files if file.inclusion.is_included() and file.src_dir != config.docs_dir]
    for pattern in PATTERNS:
        for path in sorted(REPOSITORY.glob(pattern)):
            name = path.relative_to(REPOSITORY).as_posix()
            pages.append(File.generated(config, name, abs_src_path=str(path)))
    return Files(pages)
