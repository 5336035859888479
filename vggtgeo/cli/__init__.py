"""The command line: parse arguments, call the library, print the results."""

from vggtgeo.cli.main import main as main
