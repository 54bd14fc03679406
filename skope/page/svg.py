"""Elements of drawings, SVG that is computed point by point."""

from markupsafe import Markup, escape


def tag(name: str, *children: str, **attributes: object) -> Markup:
    """Write an element.

    Args:
        name: Name of the element.
        children: What is in it; all but `Markup` is escaped.
        attributes: Attributes, which are escaped; None leaves one out. An underscore is a hyphen, one at the end
            nothing: class_ is class.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{written}>{''.join(escape(child) for child in children)}</{name}>")


def path_svg(d: str, class_: str) -> Markup:
    """A path, or nothing where there is nothing to draw."""
    return tag("path", class_=class_, d=d) if d else Markup()
