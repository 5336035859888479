"""All rows of the table of bad inputs."""

from bad_row import Row
from bad_rows_commands import COMMANDS
from bad_rows_files import FILES

ROWS: list[Row] = [*COMMANDS, *FILES]
__all__ = ["ROWS", "Row"]
