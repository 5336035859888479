"""Export a run's folder for other programs."""

from vggtgeo.export.formats import FORMATS as FORMATS
from vggtgeo.export.formats import export as export
