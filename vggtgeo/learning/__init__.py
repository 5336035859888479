"""Learning through bundle adjustment: windows with known truth, and a network that estimates match confidence.

An example of research on top of `vggtgeo.solve`; nothing else of the package uses it. Training needs optax (the extra
`notebooks`).
"""

from vggtgeo.learning.slid_windows import cut as cut
from vggtgeo.learning.slid_windows import slid_error_and_gradient as slid_error_and_gradient
from vggtgeo.learning.slid_windows import stack_sequences as stack_sequences
from vggtgeo.learning.tracked_windows import TrackedWindow as TrackedWindow
from vggtgeo.learning.tracked_windows import recorded_windows as recorded_windows
from vggtgeo.learning.tracked_windows import tracked_windows as tracked_windows
from vggtgeo.learning.training import Batch as Batch
from vggtgeo.learning.training import ConfidenceNetwork as ConfidenceNetwork
from vggtgeo.learning.training import PoseErrors as PoseErrors
from vggtgeo.learning.training import compare as compare
from vggtgeo.learning.training import error_and_gradient as error_and_gradient
from vggtgeo.learning.training import stack as stack
from vggtgeo.learning.training import train as train
from vggtgeo.learning.window_dataset import LabelledWindow as LabelledWindow
from vggtgeo.learning.window_dataset import RunWindows as RunWindows
from vggtgeo.learning.window_dataset import WindowDataset as WindowDataset
from vggtgeo.learning.window_dataset import WindowWriter as WindowWriter
from vggtgeo.learning.window_dataset import stack_windows as stack_windows
