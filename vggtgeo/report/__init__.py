"""The page of a run: one self-contained HTML file with everything that a person looks at first."""

from vggtgeo.report.page import write_page as write_page
