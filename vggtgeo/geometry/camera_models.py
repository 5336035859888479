"""Camera models as differentiable functions of their parameters: projection of points, and viewing rays of pixels.

Each model is a module with one vector of parameters, so that bundle adjustment can estimate, fix or differentiate it. A
point is given up to a positive factor, `z > 0`; a ray has `z = 1`, so fields of view stay below 180 degrees.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import cache, partial
from types import new_class
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vggtgeo.io.errors import InputError

MIN_RELATIVE_DEPTH = 1e-2
"""Lower bound of `z` in `project`, relative to the depth in the host camera. A point nearer to the camera's plane, or
behind it, is projected as if at this bound, far outside the image, where a robust kernel treats it as an outlier; the
projection never divides by zero."""

MAX_RADIUS = 2.0
"""Radius up to which `RadialTangential` evaluates its polynomial, in focal lengths, a field of view of 127 degrees.
Rays beyond it get the shift of this radius. They are outliers, whose powers of the radius would alone determine the
coefficients."""
_NEWTON_STEPS = 8
"""Newton steps to invert a distortion: convergence is quadratic, so that all digits are reached long before."""


class AbstractCamera(eqx.Module):
    """A camera model of bundle adjustment: focal lengths and principal point first, then further parameters.

    Any subclass can be adjusted and differentiated; readers and runs take a `vggtgeo.Camera` only.

    Fields:
        parameters: [q], as listed in `names`: pixels, then distortion without a unit.

    Example:
        >>> vg.cameras.KannalaBrandt.names[:4]
        ('fx', 'fy', 'cx', 'cy')

    """

    parameters: Float[Array, " q"]

    names: ClassVar[tuple[str, ...]]
    """Of the parameters, in their order."""

    @abc.abstractmethod
    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Return the pixel of a point in camera coordinates (any positive multiple of it)."""

    @abc.abstractmethod
    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        """Return the viewing ray of a pixel, with `z = 1`."""


class Pinhole(AbstractCamera):
    """`u = fx x / z + cx`, `v = fy y / z + cy`.

    Fields:
        parameters: [q], as `names` lists them.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> vg.cameras.Pinhole(jnp.array([500.0, 500.0, 320.0, 240.0])).project(jnp.array([0.1, 0.0, 1.0])).tolist()
        [370.0, 240.0]

    """

    names = ("fx", "fy", "cx", "cy")

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        return self.parameters[:2] * _flat(point) + self.parameters[2:]

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        return _ray((pixel - self.parameters[2:]) / self.parameters[:2])


class RadialTangential(AbstractCamera):
    """The pinhole after Brown-Conrady distortion, as OpenCV has it:

    `x' = x (1 + k1 r2 + k2 r2^2) + 2 p1 x y + p2 (r2 + 2 x^2)`,
    `y' = y (1 + k1 r2 + k2 r2^2) + p1 (r2 + 2 y^2) + 2 p2 x y`.

    Fields:
        parameters: [q], as `names` lists them.

    Example: without distortion it is the pinhole.
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> camera = vg.cameras.RadialTangential(jnp.array([500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0]))
        >>> camera.unproject(camera.project(jnp.array([0.1, 0.2, 1.0]))).tolist()
        [0.1, 0.2, 1.0]

    """

    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        return self.parameters[:2] * self._distort(_flat(point)) + self.parameters[2:4]

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        return _ray(_inverted(type(self)._distort, self, (pixel - self.parameters[2:4]) / self.parameters[:2]))

    def _distort(self, flat: Float[Array, "2"]) -> Float[Array, "2"]:
        k1, k2, p1, p2 = self.parameters[4:]
        radius = _norm(flat)
        x, y = flat * jnp.where(radius > MAX_RADIUS, MAX_RADIUS / jnp.maximum(radius, MAX_RADIUS), 1.0)
        r2 = x * x + y * y
        radial = k1 * r2 + k2 * r2 * r2
        return flat + jnp.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )


class KannalaBrandt(AbstractCamera):
    """The fisheye of Kannala and Brandt (2006), as OpenCV has it: the angle `t` from the axis is drawn at radius
    `t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)`.

    Fields:
        parameters: [q], as `names` lists them.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> camera = vg.cameras.KannalaBrandt(jnp.array([300.0, 300.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0]))
        >>> [round(float(value), 9) for value in camera.unproject(camera.project(jnp.array([0.4, 0.2, 1.0])))]
        [0.4, 0.2, 1.0]

    """

    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        return self.parameters[:2] * self._distort(_flat(point)) + self.parameters[2:4]

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        drawn = (pixel - self.parameters[2:4]) / self.parameters[:2]
        radius = _norm(drawn)
        angle = _inverted(_drawn_radius, self, radius)
        near = radius < 1e-4
        # tan(t) / (t stretch) near the axis is 1 + (1/3 - k1) t^2, and the radius may be zero there.
        straight = jnp.tan(angle) / jnp.where(near, 1.0, radius)
        return _ray(drawn * jnp.where(near, 1 + (1 / 3 - self.parameters[4]) * jnp.sum(drawn**2), straight))

    def _distort(self, flat: Float[Array, "2"]) -> Float[Array, "2"]:
        radius = _norm(flat)
        near = radius < 1e-4
        angle = jnp.arctan(radius)
        factor = angle * self._stretch(angle) / jnp.where(near, 1.0, radius)
        # atan(r) stretch / r near the axis is 1 + (k1 - 1/3) r^2.
        return flat * jnp.where(near, 1 + (self.parameters[4] - 1 / 3) * jnp.sum(flat**2), factor)

    def _stretch(self, angle: Float[Array, ""]) -> Float[Array, ""]:
        k1, k2, k3, k4 = self.parameters[4:]
        t2 = angle * angle
        return 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))


def _drawn_radius(camera: KannalaBrandt, angle: Float[Array, ""]) -> Float[Array, ""]:
    """Return the radius at which a fisheye draws a ray at this angle from its axis, in focal lengths."""
    return angle * camera._stretch(angle)


class SharedFocal(AbstractCamera):
    """A model with one focal length, exactly `fx = fy = f`, and the rest of `model`'s parameters.

    Fields:
        parameters: [q], as `names` lists them.

    """

    model: ClassVar[type[AbstractCamera]]

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.names = ("f", *cls.model.names[2:])

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        return self._whole().project(point)

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        return self._whole().unproject(pixel)

    def _whole(self) -> AbstractCamera:
        return self.model(jnp.concatenate([self.parameters[:1], self.parameters]))


def has_two_focal_lengths(model: type[AbstractCamera]) -> bool:
    """Return whether the first parameters of a model are `fx` and `fy`."""
    return model.names[:2] == ("fx", "fy")


# Cached: JAX compiles anew for another class, even if it is equal.
@cache
def with_shared_focal(model: type[AbstractCamera]) -> type[SharedFocal]:
    """Return a model with one focal length in place of `fx` and `fy`.

    Raises:
        InputError: the first parameters of `model` are not `fx` and `fy`.

    Example:
        >>> from vggtgeo.geometry.camera_models import with_shared_focal
        >>> with_shared_focal(vg.cameras.KannalaBrandt).names
        ('f', 'cx', 'cy', 'k1', 'k2', 'k3', 'k4')

    """
    if not has_two_focal_lengths(model):
        raise InputError(
            f"`shared_focal` needs a `model` whose first parameters are fx and fy, got `{model.__name__}` with "
            f"{', '.join(model.names)}"
        )
    # The module of `model`: a program is kept on disk by the names of its classes, if those are the package's.
    body = {"model": model, "__module__": model.__module__, "__doc__": f"`{model.__name__}` with one focal length."}
    made: type[SharedFocal] = new_class(
        f"SharedFocal{model.__name__}", (SharedFocal,), exec_body=lambda space: space.update(body)
    )
    return made


class Cameras(eqx.Module):
    """The cameras of all keyframes: one for all, or one for each group of keyframes (a rig of several cameras).

    Example: keyframes 0 and 2 were taken by the first of two cameras.
        >>> import jax.numpy as jnp
        >>> from vggtgeo.geometry.camera_models import Cameras, Pinhole
        >>> both = jnp.array([[500.0, 500.0, 320.0, 240.0], [300.0, 300.0, 160.0, 120.0]])
        >>> float(Cameras(both, Pinhole, jnp.array([0, 1, 0])).of(1).parameters[0])
        300.0

    """

    parameters: Float[Array, "*g k"]
    """`[k]` of the one camera, or `[g, k]` of each."""
    kind: type[AbstractCamera] = eqx.field(static=True)
    group: Int[Array, " n"] | None = None
    """Which camera took each keyframe; None where there is one."""

    @property
    def size(self) -> int:
        """Number of parameters of one camera, `k`."""
        return self.parameters.shape[-1]

    @property
    def seen(self) -> int:
        """Number of parameters that an edge depends on.

        Those of the target's camera and of the host's; once if all keyframes share one camera.
        """
        return self.size if self.group is None else 2 * self.size

    def of(self, keyframe: Int[Array, ""] | int, step: Float[Array, " k"] | None = None) -> AbstractCamera:
        """Return the camera that took a keyframe, after a step of its parameters."""
        own = self.parameters if self.group is None else self.parameters[self.group[keyframe]]
        return self.kind(own if step is None else own + step)

    def of_all(self, keyframes: Int[Array, " h"]) -> Float[Array, "h k"]:
        """Return the parameters of the cameras that took the keyframes."""
        if self.group is None:
            return jnp.broadcast_to(self.parameters, (len(keyframes), self.size))
        return self.parameters[self.group[keyframes]]

    def along(
        self, ends: tuple[Int[Array, ""], Int[Array, ""]], steps: list[Array]
    ) -> tuple[AbstractCamera, AbstractCamera]:
        """Return the cameras of host and target of an edge `(i, j)`, after steps of their parameters.

        steps: of the target's camera, then of the host's; or of the camera that all share.
        """
        camera = self.of(ends[1], steps[0])
        return (camera if self.group is None else self.of(ends[0], steps[1])), camera


def _flat(point: Float[Array, "3"]) -> Float[Array, "2"]:
    return point[:2] / jnp.maximum(point[2], MIN_RELATIVE_DEPTH)


def _ray(flat: Float[Array, "2"]) -> Float[Array, "3"]:
    return jnp.concatenate([flat, jnp.ones(1, flat.dtype)])


def _norm(flat: Float[Array, "2"]) -> Float[Array, ""]:
    """Return the length of a vector; its derivatives at zero are zero, not NaN."""
    squared = jnp.sum(flat * flat)
    # Two `where`: the derivative of the root at zero is infinite, also in the branch that is not taken.
    somewhere = squared > 1e-12
    return jnp.where(somewhere, jnp.sqrt(jnp.where(somewhere, squared, 1.0)), 0.0)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _inverted(
    function: Callable[[Any, Array], Array], camera: AbstractCamera, value: Float[Array, "*d"]
) -> Float[Array, "*d"]:
    """Return `x` with `function(camera, x) = value`, a number or two, by Newton's method from `x = value`."""

    def step(_: Int[Array, ""] | int, x: Array) -> Array:
        return x - _divided(function(camera, x) - value, jax.jacfwd(function, 1)(camera, x))

    return jax.lax.fori_loop(0, _NEWTON_STEPS, step, value)


@_inverted.defjvp
def _inverted_jvp(
    function: Callable[[Any, Array], Array], at: tuple[Any, Array], along: tuple[Any, Array]
) -> tuple[Array, Array]:
    """Differentiate by the implicit function theorem, in which `x` is again an inverse: exact to any order."""
    camera, value = at
    x = _inverted(function, camera, value)
    _, moved = jax.jvp(lambda camera: function(camera, x), (camera,), along[:1])
    return x, _divided(along[1] - moved, jax.jacfwd(function, 1)(camera, x))


def _divided(vector: Float[Array, "*d"], matrix: Float[Array, "*dd"]) -> Float[Array, "*d"]:
    """Return `matrix^-1 vector`, written out: a factorisation for each of many thousand pixels is many times slower."""
    if vector.ndim == 0:
        return vector / matrix
    (a, b), (c, d) = matrix
    return jnp.stack([d * vector[0] - b * vector[1], a * vector[1] - c * vector[0]]) / (a * d - b * c)
