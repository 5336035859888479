"""The command line: arguments in, text out; the work is done by the library below."""

from vggtgeo.cli.main import main as main
