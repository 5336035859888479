"""Hand-written derivatives that override automatic ones where speed matters; the tests check that both are equal."""
