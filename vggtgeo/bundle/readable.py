"""Results that are pytrees with a readable representation."""

from __future__ import annotations

import abc

import equinox as eqx


class Readable(eqx.Module):
    """A pytree whose representation is one line; inside `jit`, or for a batch, its leaves."""

    @abc.abstractmethod
    def _line(self) -> str:
        """Return the line; may raise an error of shape or type for traced values and batches."""

    def __str__(self) -> str:
        try:
            return self._line()
        except (TypeError, ValueError, IndexError):  # traced values and batches have no single number
            return eqx.Module.__repr__(self)

    __repr__ = __str__
