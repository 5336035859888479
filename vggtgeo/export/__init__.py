"""Files for other programs, made of a run's folder."""

from vggtgeo.export.formats import FORMATS as FORMATS
from vggtgeo.export.formats import export as export
