"""Initial intrinsics of a problem with their camera model and prior, as arguments of `pack`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from vggtgeo.bundle.checks import check_fixed, check_range
from vggtgeo.geometry.camera_models import AbstractCamera, Pinhole, with_shared_focal
from vggtgeo.io.argument_checks import real_numbers
from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class Intrinsics:
    """Initial intrinsics of one or several cameras, their model, their prior, and which of them are fixed.

    Fields:
        values: `[k]`, parameters of the camera, `fx, fy, cx, cy` in pixels; for other models in the order of their
            `names`; for several cameras `[g, k]`.
        model: Camera model: `Pinhole`, `RadialTangential`, `KannalaBrandt`, or your own class.
        shared_focal: One focal length, `fx = fy = f`: `values` are then `f, cx, cy`, and the distortion's.
        camera_of: int `[n]`: camera of each keyframe, a row of `values`; None: one camera for all.
        prior_mean: Mean of the prior, shape of `values`; None = `values`.
        prior_sigma: Standard deviation of the prior, pixels: one for all, or the shape of `values`; None = no prior.
        fixed: Which parameters are fixed: one bool, one for each parameter of a camera, or their full shape.

    Example:
        >>> import vggtgeo as vg
        >>> window = vg.simulate_window(keyframes=3)
        >>> known = vg.cameras.Intrinsics(window.intrinsics, fixed=True)
        >>> problem, _, _ = vg.pack(window.observations, window.start, known, window.observations.depth_mean)
        >>> problem.fixed_intrinsics.tolist()
        [True, True, True, True]

    """

    values: np.ndarray
    model: type[AbstractCamera] = Pinhole
    shared_focal: bool = False
    camera_of: np.ndarray | None = None
    prior_mean: np.ndarray | None = None
    prior_sigma: np.ndarray | float | None = None
    fixed: np.ndarray | bool = False

    def checked(self, keyframes: int) -> Intrinsics:
        """Return the same after validation: arrays in place of lists, and `shared_focal` as part of the model.

        Raises:
            InputError: a field is invalid; names it.

        """
        values, model = real_numbers("intrinsics", self.values), cast(Any, self.model)
        if not (isinstance(model, type) and issubclass(model, AbstractCamera)):
            must = "a camera class, such as `vggtgeo.cameras.RadialTangential`"
            raise InputError(f"`model` must be {must}, got {model!r:.60}")
        model = with_shared_focal(model) if self.shared_focal else model
        several, count = self.camera_of is not None, len(model.names)
        if values.ndim != 1 + several or values.shape[-1] != count:
            shape = f"(g, {count})" if several else f"({count})"
            raise InputError(
                f"`intrinsics` must have shape {shape}, {', '.join(model.names)} of each camera, got {values.shape}"
            )
        camera_of = None
        if self.camera_of is not None:
            camera_of = check_range("camera_of", self.camera_of, len(values), "rows of `intrinsics`")
            if camera_of.shape != (keyframes,):
                raise InputError(f"`camera_of` must have shape ({keyframes},), one a keyframe, got {camera_of.shape}")
        focal = [name in ("f", "fx", "fy") for name in model.names]
        if not np.all(np.isfinite(values)) or np.any(values[..., focal] <= 0):
            raise InputError(f"`intrinsics` must be finite with positive focal lengths, got {values}")
        mean = values if self.prior_mean is None else real_numbers("prior_mean", self.prior_mean)
        if mean.shape != values.shape or not np.all(np.isfinite(mean)):
            raise InputError(f"`prior_mean` must be {' x '.join(map(str, values.shape))} finite numbers, got {mean}")
        sigma = real_numbers("prior_sigma", np.inf if self.prior_sigma is None else self.prior_sigma)
        if not np.all(sigma > 0):
            raise InputError(f"`prior_sigma` must be positive, or None for no prior, got {sigma}")
        return Intrinsics(values, model, False, camera_of, mean, sigma, check_fixed("fixed", self.fixed, values.shape))
