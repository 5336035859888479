"""What a run leaves: a value in memory, files in a folder, and the way back."""

from vggtgeo.results.reading import evaluate as evaluate
from vggtgeo.results.reading import read as read
from vggtgeo.results.result import Result as Result
