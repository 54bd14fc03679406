"""The page that reports share: one HTML file with its style, its script and its pictures inside.

`html_pieces` are pieces of markup, `charts` and `vehicle_outline` drawings with their numbers below, `image_viewer`
photographs with layers.
"""

from html import escape
from importlib import resources

from skope.page.html_pieces import tag


def html_document(title: str, *body: str, plays_files: bool = False) -> str:
    """Put a whole page together from its parts.

    Args:
        title: Title of the page, plain text.
        body: Parts of its main element, markup.
        plays_files: The page may play videos that its reader chooses on their own computer.

    Returns:
        The page as HTML, with its styles and script inside; it can make no request.
    """
    media = " media-src blob:;" if plays_files else ""
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        # No request leaves the page, whatever it holds.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:;'
        f"{media} style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
        '<link rel="icon" href="data:,">'
    )
    end = tag("div", id="tip", role="status", hidden="hidden") + tag("script", _text("page.js"))
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<title>{escape(title)}</title>'
        f"{tag('style', _text('page.css'))}</head><body><main>{''.join(body)}{end}</main></body></html>\n"
    )


def _text(name: str) -> str:
    return resources.files("skope.page").joinpath(name).read_text(encoding="utf-8")
