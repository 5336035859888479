"""What a solution is worth: its covariances, what is observable, the sizes of its residuals."""

from vggtgeo.bundle.analysis.covariances import Covariances as Covariances
from vggtgeo.bundle.analysis.observability_report import Observability as Observability
from vggtgeo.bundle.objective import energy_terms as energy_terms
from vggtgeo.bundle.residual_values import ResidualSizes as ResidualSizes
from vggtgeo.bundle.residual_values import residual_sizes as residual_sizes
