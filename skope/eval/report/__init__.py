"""Make report.html: one file that shows the results of an evaluation, without a server or the network."""

from skope.eval.report.page import render_page

__all__ = ["render_page"]
