"""SVG elements of computed drawings."""

from markupsafe import Markup, escape


def tag(name: str, *children: str, **attributes: object) -> Markup:
    """Write an element.

    Args:
        name: Name of the element.
        children: Content of the element; everything except `Markup` is escaped.
        attributes: Attributes, which are escaped; None omits one. Underscores become hyphens, and a trailing one is
            dropped: class_ is class.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{written}>{''.join(escape(child) for child in children)}</{name}>")


def path_svg(d: str, class_: str) -> Markup:
    """Return a path, or empty markup if there is nothing to draw."""
    return tag("path", class_=class_, d=d) if d else Markup()
