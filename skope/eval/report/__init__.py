"""report.html: one file that shows what an evaluation found, without a server or the network."""

from skope.eval.report.page import render_page

__all__ = ["render_page"]
