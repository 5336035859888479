"""Results that are pytrees and still read well at the end of a notebook's cell."""

from __future__ import annotations

import equinox as eqx


class Readable(eqx.Module):
    """A pytree whose `repr` is its `str`; inside `jit`, or for a batch, that of its leaves."""

    def __repr__(self) -> str:
        try:
            return str(self)
        except TypeError:  # traced values and batches have no number to show
            return eqx.Module.__repr__(self)
