"""Settings of the Jinja templates of all packages."""

from jinja2 import Environment, PackageLoader, StrictUndefined


def environment(package: str, *, escapes_html: bool = False) -> Environment:
    """Return the environment of the templates in the folder ``templates`` of a package, such as ``pipeline.publish``.

    A name without a value is an error. A line that has only a block leaves no empty line.

    Args:
        escapes_html: true if values are escaped for HTML.
    """
    return Environment(
        loader=PackageLoader(package),
        autoescape=escapes_html,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
