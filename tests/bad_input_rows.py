"""All rows of the table of bad inputs."""

from bad_row import Row
from bad_rows_bags import BAGS
from bad_rows_clouds import ALL_CLOUDS
from bad_rows_commands import COMMANDS
from bad_rows_depth import DEPTH
from bad_rows_files import FILES
from bad_rows_images import ALL_IMAGES
from bad_rows_layouts import LAYOUTS
from bad_rows_lists import ALL_LISTS
from bad_rows_maps import MAPS
from bad_rows_networks import ANSWERS
from bad_rows_videos import VIDEOS

ROWS: list[Row] = [
    *COMMANDS,
    *FILES,
    *ALL_IMAGES,
    *DEPTH,
    *ALL_LISTS,
    *VIDEOS,
    *BAGS,
    *LAYOUTS,
    *MAPS,
    *ALL_CLOUDS,
    *ANSWERS,
]
__all__ = ["ROWS", "Row"]
