"""The report of a run, a self-contained HTML file, and its 3D view."""

from vggtgeo.report.map_scene import MAX_POINTS as MAX_POINTS
from vggtgeo.report.map_scene import KeyframeView as KeyframeView
from vggtgeo.report.map_scene import MapScene as MapScene
from vggtgeo.report.map_scene import keyframe_views as keyframe_views
from vggtgeo.report.map_scene import map_scene as map_scene
from vggtgeo.report.page import RunRecord as RunRecord
from vggtgeo.report.page import write_page as write_page
from vggtgeo.report.viewer import MapView as MapView
from vggtgeo.report.viewer import check_viewer as check_viewer
from vggtgeo.report.viewer import has_viewer as has_viewer
from vggtgeo.report.viewer import view_html as view_html
