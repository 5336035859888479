"""The report of a run: a self-contained HTML file."""

from vggtgeo.report.page import write_page as write_page
