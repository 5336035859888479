"""Results that are pytrees and still read well at the end of a notebook's cell."""

from __future__ import annotations

import abc

import equinox as eqx


class Readable(eqx.Module):
    """A pytree that reads as one line; inside `jit`, or for a batch, as its leaves."""

    @abc.abstractmethod
    def _line(self) -> str:
        """One result in a line; any error of a shape or a type where there is none, or there are many."""

    def __str__(self) -> str:
        try:
            return self._line()
        except (TypeError, ValueError, IndexError):  # traced values and batches have no number to show
            return eqx.Module.__repr__(self)

    __repr__ = __str__
