"""All rows of the table of bad inputs."""

from bad_row import Row
from bad_rows_bags import BAGS
from bad_rows_clouds import ALL_CLOUDS
from bad_rows_depth import DEPTH
from bad_rows_environment import ENVIRONMENT
from bad_rows_files import FILES
from bad_rows_images import ALL_IMAGES
from bad_rows_layouts import LAYOUTS
from bad_rows_lists import ALL_LISTS
from bad_rows_maps import MAPS
from bad_rows_network_files import NETWORKS
from bad_rows_networks import ANSWERS
from bad_rows_other_commands import OTHERS
from bad_rows_outputs import OUTPUT
from bad_rows_results import RESULTS, TRAJECTORIES
from bad_rows_run import RUN, SETTINGS
from bad_rows_videos import VIDEOS

ROWS: list[Row] = [
    *RUN,
    *SETTINGS,
    *OUTPUT,
    *OTHERS,
    *TRAJECTORIES,
    *NETWORKS,
    *RESULTS,
    *ENVIRONMENT,
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
